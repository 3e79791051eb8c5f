"""Render worlds, simulate their spike cameras, write scene folders."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

from rich.console import Console
from rich.progress import Progress

from spike4dgs.benchmark.errors import problem, unknown
from spike4dgs.benchmark.files import read_json, write_json
from spike4dgs.benchmark.runs.executors import Run, executor, here
from spike4dgs.benchmark.scene.cameras import check_lens
from spike4dgs.benchmark.scene.manifest import read_manifest
from spike4dgs.benchmark.scene.scene import SCHEMA
from spike4dgs.benchmark.screen.bars import Pace, left_text, make_bars, seconds_text
from spike4dgs.benchmark.variants import is_reserved
from spike4dgs.generators.physics import NO_OPTIONS, PhysicsOptions
from spike4dgs.generators.profiles import PROFILES, RATE_HZ, SPLIT_PROFILES, TARGET_EVERY, TRACKS, Job, with_finer
from spike4dgs.generators.render_tasks import cameras_of, world_of
from spike4dgs.generators.rendering.mitsuba_variant import pick_variant
from spike4dgs.generators.scene_check import check_scenes, find_references
from spike4dgs.generators.scene_maker import Maker
from spike4dgs.generators.shared_rendering import SharingMaker, rendering_of

T = TypeVar("T")
_MOST_SECONDS = 10  # a length of 0.02 renders for minutes; of longer clips, manifest.json would be too large to read
_LINE_EVERY_S = 20.0  # between progress lines where the output is no terminal


@dataclass(frozen=True)
class SceneSettings:
    """What a scene shows, and how exactly.

    Args:
        profile: tiny (4 views, 64x40, 4 ms: for tests), small (9 views, 200x125, 20 ms), paper (9, 400x250, 100 ms).
        seed: Seed of all random numbers: the world's details, the rendering, the sensors.
        variant: Variant of the world; 0, 3 and 4 are the public benchmark, 9000 and up are kept for hidden seasons.
        seconds: Length of the clip, to whole milliseconds; the profile's if left out.
        gain_map: Give every pixel its own sensitivity.
        dark_map: Give every pixel its own dark rate.
        shot_noise: Simulate the random arrival of photons.
        adaptive_keys: Render each pixel as often as its motion requires. Without it, every changing pixel is rendered
            at every tick, which is slow.
        sub_ticks: Render instants inside a tick where the motion within one tick is too large.
        whole_frames: Trace every pixel of each coarse key frame, not only the region that changes (slow and noisier).
        rendering: paths traces whole paths (release 1); split traces direct light and takes soft light from smoothed
            maps, with a tenth of the noise and denser key frames. split needs Mitsuba's LLVM or CUDA variant.
        physics: Deviations from ideal cameras and lamps.
    """

    profile: str = "small"
    seed: int = 0
    variant: int = 0
    seconds: float | None = None
    gain_map: bool = True
    dark_map: bool = True
    shot_noise: bool = True
    adaptive_keys: bool = True
    sub_ticks: bool = True
    whole_frames: bool = False
    rendering: Literal["paths", "split"] = "paths"
    physics: PhysicsOptions = NO_OPTIONS

    def job(self, world: str) -> Job:
        """Return the scene of a world. Raises UserError for unknown names and impossible numbers."""
        from spike4dgs.generators.worlds import WORLDS  # it loads other packages' worlds

        if world not in WORLDS:
            raise unknown("world", world, WORLDS)
        if self.profile not in PROFILES:
            raise unknown("--profile", self.profile, PROFILES)
        if self.seed < 0 or self.variant < 0:
            raise problem("--seed and --variant", "numbers from 0 up", f"{self.seed}, {self.variant}", "correct them")
        profile = (PROFILES if self.rendering == "paths" else SPLIT_PROFILES)[self.profile]
        length = profile.seconds if self.seconds is None else self.seconds
        ticks = length * RATE_HZ if length <= _MOST_SECONDS else -1.0
        if not ticks >= 2 * TARGET_EVERY or abs(ticks / TARGET_EVERY - round(ticks / TARGET_EVERY)) > 1e-6:
            expected, fix = f"whole milliseconds, from 0.002 to {_MOST_SECONDS:g}", "give seconds such as 0.02"
            raise problem("--seconds", expected, str(self.seconds), fix)
        physics = self.physics.physics()
        gaps = len(profile.views) * ticks * physics.lost_ticks * (1 - physics.lost_ticks)
        if gaps > 100_000:  # likewise of scene.json
            raise problem("--lost-ticks", "at most 100000 gaps", f"about {gaps:.0f}", "make a shorter clip")
        if physics.moves_array and self.rendering == "split":
            expected, fix = "an array that stands still", "make it with --rendering paths"
            raise problem("--rendering split", expected, "--array-motion or --array-rotation", fix)
        return Job(
            world,
            self.variant,
            self.seed,
            self.profile,
            profile,
            round(ticks) / RATE_HZ,
            gain_map=self.gain_map,
            dark_map=self.dark_map,
            shot_noise=self.shot_noise,
            adaptive=self.adaptive_keys,
            sub_ticks=self.sub_ticks,
            whole_frames=self.whole_frames,
            physics=physics,
        )


def track_jobs(track: str, worlds: Sequence[str], settings: SceneSettings) -> list[Job]:
    """Return the scenes of a track that show these worlds, world by world.

    Raises UserError for an unknown track, and for settings that are the track's.
    """
    if track not in TRACKS:
        raise unknown("--track", track, TRACKS)
    if settings != SceneSettings():
        fix = "leave one out"
        raise problem("--track", "a track, which has its own profile, variants and camera", "settings too", fix)
    t = TRACKS[track]
    physics = replace(settings.physics, camera=t.camera)
    common = replace(settings, profile=t.profile, rendering="split", physics=physics)
    every = [replace(common, variant=variant) for variant in t.variants]
    jobs = [one.job(world) for world in worlds for one in every]
    return [replace(j, profile=with_finer(j.profile, t.finer[j.world])) if j.world in t.finer else j for j in jobs]


def make_dataset(
    jobs: Sequence[Job],
    out: Path,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    audit: bool = False,
    replace: bool = False,
    check: Path | None = None,
) -> int:
    """Make the scenes that are absent as OUT/ID, each with a report OUT/ID.report.json of the time of its stages.

    Scenes that differ by what cameras and light make of a rendering alone are rendered once.
    Existing scenes are checked and kept, or with `replace` made again. Equal jobs give equal bytes, with any number of
    workers (of this machine, or a dask.distributed scheduler's). With `audit` random ticks are compared with full
    renderings, and with `check` the scenes with those of the same id in that folder. Return 1 where one of these
    differs by more than noise.
    """
    if twice := [name for name, count in Counter(job.id for job in jobs).items() if count > 1]:
        raise problem("scenes", "each once", f"{twice[0]} twice", "leave one out")
    console = Console(highlight=False, soft_wrap=True)
    for variant in {job.variant: None for job in jobs if is_reserved(job.variant)}:
        console.print(f"variant {variant} is kept for hidden seasons: train nothing on it, and enter no scores of it")
    references = find_references(check, [job.id for job in jobs]) if check else {}
    todo = [job for job in jobs if not _is_done(job, out, replace)]
    for job in jobs:
        if job not in todo:
            note = "; pass --replace to make and audit it again" if audit else ""
            console.print(f"{job.id}: complete and undamaged, kept: {out / job.id}{note}", markup=False)
    if todo:
        chosen = pick_variant()  # fails here, before anything is written, if it cannot render
        for job in (job for job in todo if job.physics.lens or job.physics.psf_px or job.profile.soft):
            if chosen.startswith("scalar"):
                fix = "install libLLVM, see `spike4dgs doctor`, or use --device cuda"
                raise problem("--lens, --psf-px and --rendering split", "Mitsuba's LLVM or CUDA variant", chosen, fix)
            if job.profile.soft and (len(world_of(job).mirrors) or world_of(job).flash):
                expected = "a world without mirrors, glass and flashes"
                raise problem("--rendering split", expected, job.world, "make it with --rendering paths")
            for camera in cameras_of(job):
                check_lens(camera, "--lens")
        for job in todo:
            if job.physics.moves_array and world_of(job).flash:
                fix = "leave out --array-motion and --array-rotation"
                raise problem("an array that moves", "a world in steady light", job.world, fix)
    plans = _planned(jobs, todo)
    apart = len(plans) // workers * workers if workers > 1 and scheduler is None else 0
    with executor(workers, scheduler) as run:
        if apart:
            for _ in run(_MakeScenes(out, audit), plans[:apart]):
                pass
        making = partial(_make, run=run, in_process=workers == 1 and scheduler is None, console=console)
        for plan in plans[apart:]:
            for one in plan:
                making(one, out, with_audit=audit)

        def make(job: Job, folder: Path) -> None:
            if not _is_done(job, folder, job.id in {j.id for j in todo}):
                making(_Planned(job, ", other noise"), folder, with_audit=False)

        return check_scenes(jobs, out, references, make) if check else 0


class _Planned(NamedTuple):
    """A scene to make."""

    job: Job
    which: str = ""  # of all, as its title says
    has_others: bool = False  # scenes of its rendering
    is_last: bool = True  # of them


def _planned(jobs: Sequence[Job], todo: Sequence[Job]) -> list[list[_Planned]]:
    """Return the scenes that are to be made, those of one rendering together."""
    renderings, number = Counter(map(rendering_of, jobs)), count(1)
    groups: dict[Job, list[Job]] = {}
    for job in sorted(todo, key=lambda job: job.physics.flicker > 0):  # last: it leaves no ground truth for others
        groups.setdefault(rendering_of(job), []).append(job)

    def planned(job: Job, rendering: Job) -> _Planned:
        which = f" ({next(number)} of {len(todo)})" if len(todo) > 1 else ""
        return _Planned(job, which, renderings[rendering] > 1, job is groups[rendering][-1])

    return [[planned(job, rendering) for job in group] for rendering, group in groups.items()]


@dataclass(frozen=True)
class _MakeScenes:
    """Makes whole scenes one after another, on the core of a worker process: no worker waits for another."""

    out: Path
    audit: bool

    def __call__(self, plan: Sequence[_Planned]) -> None:
        console = Console(highlight=False, soft_wrap=True, force_terminal=False, force_jupyter=False)
        for one in plan:
            _make(one, self.out, run=here, in_process=True, console=console, with_audit=self.audit)


def _make(one: _Planned, out: Path, *, run: Run, in_process: bool, console: Any, with_audit: bool) -> None:
    """Make one scene and its report."""
    start, job = time.perf_counter(), one.job
    with _stages(console, job.id + one.which) as watch:
        maker = (SharingMaker if one.has_others else Maker)(job, out, watch, run, with_audit, in_process)
        folder = maker.make()
    if isinstance(maker, SharingMaker) and one.is_last:
        maker.forget()
    total = time.perf_counter() - start
    report = {"scene": job.id, "stages_s": maker.seconds, "total_s": round(total, 2), "settings": job.settings}
    plan = {"spacings_ticks": list(maker.plan.chain), "sub_ticks": maker.plan.sub_ticks, "keys": len(maker.plan.ticks)}
    write_json(out / f"{job.id}.report.json", report | {"plan": plan, "audit": maker.audit})
    console.print(f"{job.id}: {total:.0f} s, written to {folder}", markup=False)


def _is_done(job: Job, out: Path, replace: bool) -> bool:
    """Return whether the scene exists, complete and with these settings.

    Raises UserError where another folder has its name, and, unless `replace`, for a damaged scene or other settings.
    """
    folder = out / job.id
    if not folder.exists():
        return False
    meta = read_json(folder / "scene.json", "a scene") if (folder / "scene.json").is_file() else {}
    if meta.get("schema") != SCHEMA or meta.get("id") != job.id:
        raise problem(folder, f"scene {job.id} or nothing", "other files", "move them away or choose another --out")
    if replace:
        return False
    source = meta.get("source", {})
    different = [k for k, v in job.settings.items() if source.get(k) != v]
    if different:
        found = ", ".join(f"{k} {source.get(k)!r} instead of {job.settings[k]!r}" for k in different)
        raise problem(folder, "a scene with these settings", found, "pass --replace to make it again")
    for line in read_manifest(folder).problems():
        raise problem(folder, "an undamaged scene", line, "pass --replace to make it again")
    return True


@contextmanager
def _stages(console: Console, title: str) -> Iterator[Any]:
    """Show stages with their remaining time: bars on a terminal or in a notebook, a line now and then elsewhere."""
    with make_bars(console) as bars:

        def watch(stage: str, steps: Iterable[T], total: int) -> Iterator[T]:
            return _bar(bars, f"{title}: {stage}", steps, total)

        def lines(stage: str, steps: Iterable[T], total: int) -> Iterator[T]:
            return _lines(console, f"{title}: {stage}", steps, total)

        yield watch if console.is_terminal or console.is_jupyter else lines


def _bar(bars: Progress, title: str, steps: Iterable[T], total: int) -> Iterator[T]:
    pace = Pace()
    task = bars.add_task(title, total=total, pace=pace)
    for done, step in enumerate(steps, start=1):
        yield step
        pace.at(done, total)
        bars.update(task, completed=done)


def _lines(console: Console, title: str, steps: Iterable[T], total: int) -> Iterator[T]:
    pace, start = Pace(), time.perf_counter()
    shown = start
    for done, step in enumerate(steps, start=1):
        yield step
        pace.at(done, total)
        now = time.perf_counter()
        if done == total or now - shown > _LINE_EVERY_S:
            shown = now
            facts = f"{title} {done}/{total}", seconds_text(now - start), left_text(pace.left()) if done < total else ""
            console.print(", ".join(filter(None, facts)), markup=False)
