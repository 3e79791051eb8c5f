"""Making a whole scene folder from a world, in stages that each resume: key frames, ground truth, streams, description.

Work in progress is in OUT/.work/ID/ (key frames, and the growing scene in scene/). A single rename moves it to OUT/ID/,
so a scene folder is complete or absent. Every file of a stage is written atomically and is a function of the settings
alone, so a resumed scene equals an uninterrupted one byte for byte. Values that differ between runs, such as a time of
day or a duration, do not enter the scene.
"""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from spike4dgs import benchmark
from spike4dgs.benchmark.environment import installed_version
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import locked, read_json, remove_parts, sha256_json, write_json, writing
from spike4dgs.benchmark.runs.executors import Run, chunked, here
from spike4dgs.benchmark.runs.method_code import sources_sha256
from spike4dgs.benchmark.scene.cameras import Camera, to_nerfstudio
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import Target, open_scene
from spike4dgs.benchmark.scene.splits import standard_splits
from spike4dgs.benchmark.scene.writer import SceneDescription, finish_scene
from spike4dgs.benchmark.spikes.stream import bytes_per_tick
from spike4dgs.generators import render_tasks, streams
from spike4dgs.generators.physics import given_cameras
from spike4dgs.generators.previews import contact_sheet, preview
from spike4dgs.generators.profiles import RATE_HZ, TARGET_EVERY, Job
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.keyframes import KeyStore, read_arrays, write_arrays
from spike4dgs.generators.rendering.lights.layers import key_store
from spike4dgs.generators.rendering.mitsuba_variant import load_mitsuba
from spike4dgs.generators.rendering.render import StaticViews
from spike4dgs.generators.truth import audit, mask_file, write_truth
from spike4dgs.generators.worlds import WORLDS, WorldScene

LICENCE = "CC0-1.0"
_BYTES_PER_KEY_PIXEL = 3.0  # in a key file, seldom exceeded
_BYTES_PER_TRUTH_PIXEL = 20.0

T = TypeVar("T")
Watch = Callable[[str, Iterable[T], int], Iterator[T]]  # (stage, steps, number of steps) -> the steps, shown


@dataclass
class Maker:
    """Makes one scene below `out`; `watch` shows the progress of the stages, `run` does the rendering.

    For example::

        Maker(job, Path("data"), watch).make()
    """

    job: Job
    out: Path
    watch: Watch[Any]
    run: Run = here
    with_audit: bool = False
    in_process: bool = True  # what `run` does: then each key is stored and shown as it is done
    seconds: dict[str, float] = field(default_factory=dict)  # wall time of each stage in this process
    audit: dict[str, Any] | None = None  # the report of `audit`

    def make(self) -> Path:
        """Make or resume the scene, then move it to OUT/ID, replacing an existing scene. Return OUT/ID."""
        with _alone(self._work.with_name(f"{self.job.id}.lock")):
            self._open_work()
            remove_parts(self._work)
            self._timed("background", self._render_static)
            self._timed("key frames", self._render_keys)
            self._timed("ground truth", self._render_targets)
            self._timed("streams", self._simulate)
            self._timed("description", self._describe)
            if self.with_audit:
                self._timed("audit", self._audit)
            return self._publish()

    def _timed(self, stage: str, work: Callable[[], None]) -> None:
        start = time.perf_counter()
        work()
        self.seconds[stage] = round(time.perf_counter() - start, 2)

    # ------------------------------------------------------------ inputs of all stages

    @cached_property
    def world(self) -> WorldScene:
        """The world as this job builds it."""
        return render_tasks.world_of(self.job)

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras of the profile."""
        return render_tasks.cameras_of(self.job)

    @cached_property
    def plan(self) -> KeyPlan:
        """The ticks at which each pixel is rendered."""
        return render_tasks.plan_of(self.job)

    @property
    def _work(self) -> Path:
        return self.out / ".work" / self.job.id

    @property
    def _scene(self) -> Path:
        return self._work / "scene"

    @cached_property
    def store(self) -> KeyStore:
        """The key frames."""
        return key_store(self._work / "keys", self.world)

    @cached_property
    def targets(self) -> tuple[Target, ...]:
        """All ground-truth images: each millisecond at the held-out camera, sparse ticks at the others."""
        held_out = render_tasks.held_out_view(self.job)
        dense, sparse = self.job.target_ticks, self.job.sparse_ticks
        return tuple(Target(c.id, t) for v, c in enumerate(self.cameras) for t in (dense if v == held_out else sparse))

    @cached_property
    def _versions(self) -> dict[str, str]:
        packages = ("spike4dgs", "mitsuba", "drjit", "mujoco", "numba", "numpy", "scipy")
        found = {package: installed_version(package) or "unknown" for package in packages}
        return {"mitsuba_variant": str(load_mitsuba().variant()), **found}

    # ------------------------------------------------------------ stages

    def _open_work(self) -> None:
        """Make the work folder, or keep it if it belongs to the same settings and programs."""
        key = work_key(self.job.settings, self._versions)
        path = self._work / "settings.json"
        if path.is_file() and read_json(path, "the settings of unfinished work").get("key") != key:
            shutil.rmtree(self._work)
        with writing(self._work):
            self._work.mkdir(parents=True, exist_ok=True)
        if (free := shutil.disk_usage(self._work).free) < self._bytes_needed and not path.is_file():
            expected, found = f"about {self._bytes_needed / 1e9:.1f} GB of free disk space", f"{free / 1e9:.1f} GB"
            raise problem(self.out, expected, found, "free some space or choose a smaller profile")
        write_json(path, {"key": key, "settings": self.job.settings, "versions": self._versions})

    @property
    def _bytes_needed(self) -> float:
        p = self.job.profile
        pixels, ticks = p.width * p.height, self.job.n_ticks + streams.CALIBRATION_TICKS
        spikes = len(p.views) * ticks * bytes_per_tick(p.width, p.height)
        keys = len(self.plan.ticks) * len(p.views) * pixels * _BYTES_PER_KEY_PIXEL
        return spikes + keys + len(self.targets) * pixels * _BYTES_PER_TRUTH_PIXEL

    def _render_static(self) -> None:
        path = self._work / "targets.npz"  # written last
        if self.store.has_static and path.is_file():
            return
        static = render_tasks.render_static(self.job, self._work / "background", self.run, self.watch)
        self.store.set_static(static.views)
        truth = static.truth.arrays()
        if static.truth.background is static.views.background:
            del truth["background"]
        write_arrays(path, {**truth, "points": static.points})

    def _render_keys(self) -> None:
        missing = self.store.missing(self.plan)
        if not missing:
            return

        chunks = [[tick] for tick in missing] if self.in_process else render_tasks.key_chunks(self.job, missing)

        def keys() -> Iterator[int]:
            for chunk in self.run(render_tasks.RenderKeys(self.job, self.store.static()), chunks):
                for tick, arrays in chunk:
                    self.store.put(tick, arrays)
                    yield tick

        for _ in self.watch("key frames", keys(), len(missing)):
            pass

    def _render_targets(self) -> None:
        missing = {t for t in self.targets if not mask_file(self._scene, t).is_file()}
        if not missing:
            return
        arrays = {"background": self.store.static().background, **read_arrays(self._work / "targets.npz")}
        static = StaticViews.from_arrays(arrays)
        light_range = lru_cache(maxsize=None)(lambda view: self.store.range(view, self.plan))

        def truths() -> Iterator[Target]:
            ticks = chunked(sorted({t.tick for t in missing}), 1 if self.in_process else 2)
            for chunk in self.run(render_tasks.RenderTargets(self.job, static), ticks):
                for truth in chunk:
                    target, ground = Target(self.cameras[truth.view].id, truth.tick), self.store.background[truth.view]
                    if target in missing:
                        light = self.job.light_at(truth.tick)
                        write_truth(self._scene, target, truth, ground, partial(light_range, truth.view), light)
                        yield target

        for _ in self.watch("ground truth", truths(), len(missing)):
            pass

    def _simulate(self) -> None:
        missing = [v for v, c in enumerate(self.cameras) if not streams.is_done(self._scene, c)]
        for view in self.watch("streams", missing, len(missing)):
            streams.write_camera(self._scene, self.job, self.cameras[view], self.store, view, self.plan)

    def _describe(self) -> None:
        for part in self._scene.rglob(".*.part*"):  # left behind by a killed process
            part.unlink()
        job, held_out = self.job, self.cameras[render_tasks.held_out_view(self.job)].id
        splits = standard_splits(self.cameras, held_out)
        cameras = given_cameras(self.cameras, held_out, job.physics, [job.seed, job.variant, *job.world.encode()])
        if job.physics.moves_poses:
            write_json(self._scene / "truth/cameras.json", {c.id: to_nerfstudio(c) for c in self.cameras})
        if path := render_tasks.path_of(job):
            write_json(
                self._scene / "truth/array_path.json", path.described(range(0, job.n_ticks + 1, TARGET_EVERY), RATE_HZ)
            )
        scored = {c for split in splits.values() for c in split.test}
        finish_scene(
            self._scene,
            SceneDescription(
                id=job.id,
                title=f"{WORLDS[job.world].title} (variant {job.variant})",
                licence=LICENCE,
                cameras=cameras,
                train=splits["center"].train,
                test=splits["center"].test,
                splits=splits,
                rate_hz=float(RATE_HZ),
                n_ticks=job.n_ticks,
                radiance_gain=streams.radiance_gain(job),
                targets=tuple(t for t in self.targets if t.camera in scored),
                sensor=streams.sensor_facts(job),
                source={
                    **job.settings,
                    "keys": {"spacings_ticks": list(self.plan.chain), "sub_ticks": self.plan.sub_ticks},
                    "notes": dict(self.world.notes),
                    "versions": self._versions,
                },
                points=self._points,
                gaps=tuple(gap.record for c in cameras for gap in streams.gaps_of(job, c)),
                extras=streams.extras(job) | {"instances": self._object_names},
            ),
        )
        clip = self.store.instants(render_tasks.held_out_view(job), self.plan)
        scene = open_scene(self._scene, allow_gaps=True)
        preview(clip.keys, clip.ticks, scene.stream(held_out), scene.radiance_gain, self._scene / "preview.webp")
        contact_sheet(scene, self._scene / "sheet.png")
        write_manifest(self._scene)

    def _audit(self) -> None:
        for _ in self.watch("audit", range(1), 1):
            self.audit = audit(self.job, self.store, self.plan, self._scene)

    def _publish(self) -> Path:
        final = self.out / self.job.id
        old = self._work / "replaced"
        with writing(final):
            if final.exists():
                os.rename(final, old)
            os.rename(self._scene, final)
        shutil.rmtree(self._work)
        return final

    @property
    def _points(self) -> NDArray[np.float64]:
        return read_arrays(self._work / "targets.npz", "points")["points"]

    @property
    def _object_names(self) -> dict[str, str]:
        """Names of the moving objects by their number in the geometry files."""
        return {str(k): name for k, name in enumerate(self.world.object_names, start=1)}


def work_key(settings: dict[str, Any], versions: dict[str, str]) -> str:
    """Return the key of unfinished work, which no other code of this room, `benchmark` or the world takes up."""
    return sha256_json([settings, versions, _sources(settings["world"])])


@cache
def _sources(world: str) -> str:
    room, package = __name__.rpartition(".")[0], WORLDS[world].package
    others = {package} - {room.partition(".")[0]}
    return sources_sha256([sys.modules[name] for name in (room, benchmark.__name__, *others)])


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Keep a second process off the same scene, and remove the lock file where the scene is done."""
    with locked(path, path.stem, "a scene that nobody else makes", temporary=True):
        yield
    with suppress(OSError):  # another process still has files there, or was the last
        path.parent.rmdir()
