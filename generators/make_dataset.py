"""`make-dataset`: render worlds, simulate their spike cameras, write scene folders."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from tyro.conf import Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.variants import is_reserved
from spike4dgs.generators.profiles import PROFILES, RATE_HZ, TARGET_EVERY, Job

if TYPE_CHECKING:
    from rich.progress import Progress

    from spike4dgs.benchmark.runs.executors import Run

T = TypeVar("T")
_MOST_SECONDS = 60  # a length of 0.02 renders for minutes
_LINE_EVERY_S = 20.0  # between progress lines where the output is no terminal


def make_dataset(
    worlds: Positional[tuple[str, ...]] = (),
    *,
    all: bool = False,
    profile: str = "small",
    out: Path = Path("data"),
    seed: int = 0,
    variant: int = 0,
    seconds: float | None = None,
    gain_map: bool = True,
    dark_map: bool = True,
    shot_noise: bool = True,
    adaptive_keys: bool = True,
    sub_ticks: bool = True,
    whole_frames: bool = False,
    lens: tuple[float, ...] = (),
    lens_spread: float = 0.0,
    workers: int = 1,
    scheduler: str | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    audit: bool = False,
    replace: bool = False,
    check: Path | None = None,
) -> int:
    """Render worlds and simulate their spike cameras: one scene folder OUT/WORLD-VARIANT-PROFILE for each world.

    Give the same command again to resume a killed run. Existing scenes are checked and kept. OUT/ID.report.json lists
    the time of each stage. Equal arguments give equal bytes, with any number of workers.

    Args:
        worlds: Names of worlds, such as car turntable.
        all: Make all worlds.
        profile: tiny (4 views, 64x40, 4 ms: for tests), small (9 views, 200x125, 20 ms), paper (9, 400x250, 100 ms).
        out: Folder in which the scene folders appear.
        seed: Seed of all random numbers: the world's details, the rendering, the sensors.
        variant: Variant of the world; 0 is the public benchmark, 9000 and up are kept for hidden seasons.
        seconds: Length of the clip if not the profile's, in whole milliseconds.
        gain_map: Give every pixel its own sensitivity.
        dark_map: Give every pixel its own dark rate.
        shot_noise: Simulate the random arrival of photons.
        adaptive_keys: Render each pixel as often as its motion requires, not every changing pixel at every tick (slow).
        sub_ticks: Render instants inside a tick where the motion in one tick is too large.
        whole_frames: Trace every pixel of every key, not only the region that changes (slow, and noisier).
        lens: Distortion of every camera's lens: OpenCV's k1, k2, p1, p2, k3, or the first of them, such as -0.15 0.03.
            Streams, other recordings and ground truth all show it. The scene's id ends in -lens.
        lens_spread: Largest share by which a camera's coefficients differ from --lens, such as 0.3; the seed draws it.
        workers: Processes that render.
        scheduler: Address of a dask.distributed scheduler, tcp://HOST:PORT, whose workers render.
        device: cpu, cuda (needs an NVIDIA GPU), or auto: the CPU unless SPIKE4DGS_MITSUBA_VARIANT says otherwise.
        audit: Compare random ticks and ground truth with full renderings of 4 times the samples; see the report.
        replace: Make damaged scenes, and scenes with other settings, again.
        check: A folder of reference scenes, such as a release, or one scene folder. Scenes in OUT are made only where
            they are absent, and compared with those of the same id there: equal, rendering noise, or a change of the
            world. A scene that is not equal is rendered again with other noise. The report: OUT/check.md, .json, .png.
    """
    from rich.console import Console

    from spike4dgs.benchmark.runs.executors import executor
    from spike4dgs.benchmark.scene.cameras import check_lens
    from spike4dgs.generators.render_tasks import cameras_of
    from spike4dgs.generators.rendering.mitsuba_variant import choose_device, pick_variant
    from spike4dgs.generators.scene_check import check_scenes, find_references

    console = Console(highlight=False, soft_wrap=True)
    if all and worlds:
        raise problem("worlds", "names or --all", "both", "leave one out")
    switches: dict[str, Any] = {
        "lens": _lens(lens, audit),
        "lens_spread": _lens_spread(lens_spread, lens),
        "gain_map": gain_map,
        "dark_map": dark_map,
        "shot_noise": shot_noise,
        "adaptive": adaptive_keys,
        "sub_ticks": sub_ticks,
        "whole_frames": whole_frames,
    }
    names = _all_names() if all else dict.fromkeys(worlds)
    jobs = [_job(w, profile, seed, variant, seconds, switches) for w in names]
    if not jobs:
        raise problem("worlds", "at least one world, or --all", "none", f"choose among {_names()}")
    if seed < 0 or variant < 0:
        raise problem("--seed and --variant", "numbers from 0 up", f"{seed}, {variant}", "correct them")
    if is_reserved(variant):
        console.print(f"variant {variant} is kept for hidden seasons: train nothing on it, and enter no scores of it")
    choose_device(device)
    references = find_references(check, [job.id for job in jobs]) if check else {}
    todo = [job for job in jobs if not _is_done(job, out, replace)]
    for job in jobs:
        if job not in todo:
            note = "; pass --replace to make and audit it again" if audit else ""
            console.print(f"{job.id}: complete and undamaged, kept: {out / job.id}{note}", markup=False)
    if todo:
        chosen = pick_variant()  # fails here, before anything is written, if it cannot render
        if lens and chosen.startswith("scalar"):
            fix = "install libLLVM, see `spike4dgs doctor`, or use --device cuda"
            raise problem("--lens", "Mitsuba's LLVM or CUDA variant", chosen, fix)
        for job in todo if lens else ():
            for camera in cameras_of(job):
                check_lens(camera, "--lens")
    with executor(workers, scheduler) as run:
        for number, job in enumerate(todo, start=1):
            _make(job, out, run, audit, console, f" ({number} of {len(todo)})" if len(todo) > 1 else "")

        def make(job: Job, folder: Path) -> None:
            if not _is_done(job, folder, False):
                _make(job, folder, run, False, console, ", other noise")

        return check_scenes(jobs, out, references, make) if check else 0


def _make(job: Job, out: Path, run: Run, with_audit: bool, console: Any, which: str) -> None:
    """Make one scene and its report."""
    from spike4dgs.benchmark.files import write_json
    from spike4dgs.generators.scene_maker import Maker

    start = time.perf_counter()
    with _stages(console, job.id + which) as watch:
        maker = Maker(job, out, watch, run, with_audit)
        folder = maker.make()
    total = time.perf_counter() - start
    report = {"scene": job.id, "stages_s": maker.seconds, "total_s": round(total, 2), "settings": job.settings}
    plan = {"spacings_ticks": list(maker.plan.chain), "sub_ticks": maker.plan.sub_ticks, "keys": len(maker.plan.ticks)}
    write_json(out / f"{job.id}.report.json", report | {"plan": plan, "audit": maker.audit})
    console.print(f"{job.id}: {total:.0f} s, written to {folder}", markup=False)


def _job(world: str, profile: str, seed: int, variant: int, seconds: float | None, switches: dict[str, Any]) -> Job:
    if world not in _all_names():
        raise problem("world", f"one of {_names()}", repr(world), "correct the name")
    if profile not in PROFILES:
        raise problem("--profile", f"one of {', '.join(PROFILES)}", repr(profile), "correct the name")
    length = PROFILES[profile].seconds if seconds is None else seconds
    ticks = length * RATE_HZ if length <= _MOST_SECONDS else -1.0
    if not ticks >= 2 * TARGET_EVERY or abs(ticks / TARGET_EVERY - round(ticks / TARGET_EVERY)) > 1e-6:
        fix = "give seconds such as 0.02"
        raise problem("--seconds", f"whole milliseconds, from 0.002 to {_MOST_SECONDS:g}", str(seconds), fix)
    return Job(world, variant, seed, profile, PROFILES[profile], round(ticks) / RATE_HZ, **switches)


def _lens(values: tuple[float, ...], audit: bool) -> tuple[float, ...]:
    """Return the five coefficients of a lens, none for a pinhole. Raises UserError for others than numbers."""
    from spike4dgs.benchmark.scene.lens import NAMES, make_distortion

    if len(values) > len(NAMES) or not all(map(math.isfinite, values)):
        raise problem("--lens", f"at most {len(NAMES)} numbers: {', '.join(NAMES)}", str(values), "correct it")
    if values and audit:
        raise problem("--audit", "pinhole cameras, which Mitsuba's own sensor can be", "--lens", "leave one out")
    return make_distortion(values)


def _lens_spread(share: float, lens: tuple[float, ...]) -> float:
    """Return the share by which lenses differ. Raises UserError for one outside [0, 1), and where there is no lens."""
    if not 0 <= share < 1:
        raise problem("--lens-spread", "a share from 0 to below 1", f"{share:g}", "correct it")
    if share and not lens:
        raise problem("--lens-spread", "the mean lens, --lens", "none", "give both, or leave both out")
    return share


def _all_names() -> list[str]:
    from spike4dgs.generators.worlds import WORLDS

    return list(WORLDS)


def _names() -> str:
    return ", ".join(_all_names())


def _is_done(job: Job, out: Path, replace: bool) -> bool:
    """Return whether the scene exists, complete and with these settings.

    Raises UserError where another folder has its name, and, unless `replace`, for a damaged scene or other settings.
    """
    from spike4dgs.benchmark.files import read_json
    from spike4dgs.benchmark.scene.manifest import read_manifest
    from spike4dgs.benchmark.scene.scene import SCHEMA

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
def _stages(console: Any, title: str) -> Iterator[Any]:
    """Show stages with their remaining time: bars on a terminal, a line from time to time elsewhere."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as Left

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TextColumn("left"), Left(), console=console, disable=not console.is_terminal) as bars:

        def watch(stage: str, steps: Iterable[T], total: int) -> Iterator[T]:
            return _bar(bars, f"{title}: {stage}", steps, total)

        def lines(stage: str, steps: Iterable[T], total: int) -> Iterator[T]:
            return _lines(console, f"{title}: {stage}", steps, total)

        yield watch if console.is_terminal else lines


def _bar(bars: Progress, title: str, steps: Iterable[T], total: int) -> Iterator[T]:
    task = bars.add_task(title, total=total)
    for step in steps:
        yield step
        bars.advance(task)


def _lines(console: Any, title: str, steps: Iterable[T], total: int) -> Iterator[T]:
    start = shown = time.perf_counter()
    for done, step in enumerate(steps, start=1):
        yield step
        now = time.perf_counter()
        if done == total or now - shown > _LINE_EVERY_S:
            shown = now
            left = (now - start) / done * (total - done)
            console.print(f"{title} {done}/{total}, {now - start:.0f} s, about {left:.0f} s left", markup=False)
