"""From a world to a whole scene folder, in stages that each resume: key frames, ground truth, streams, description.

Work in progress lives in OUT/.work/ID/ (key frames, and the growing scene in scene/) and is one rename away from
OUT/ID/, so a scene folder is whole or absent. Every file of a stage is written atomically and is a function of the
settings alone; a resumed scene therefore equals an uninterrupted one byte for byte. Nothing that varies between runs,
such as a time of day or a duration, enters the scene.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_opening

from spike4dgs.benchmark.cameras import Camera
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_json, sha256_json, write_json
from spike4dgs.benchmark.images import write_exr, write_mask
from spike4dgs.benchmark.scene import Target
from spike4dgs.benchmark.scene_writer import SceneDescription, finish_scene, stream_name
from spike4dgs.benchmark.spikes import SpikeWriter, bytes_per_tick
from spike4dgs.generators.keyframes import KeyStore
from spike4dgs.generators.mitsuba_variant import load_mitsuba
from spike4dgs.generators.motion import key_ticks, max_image_speed
from spike4dgs.generators.profiles import RATE_HZ, Job
from spike4dgs.generators.render import MultiViewRenderer
from spike4dgs.generators.rig import HELD_OUT_VIEW, cameras
from spike4dgs.generators.sensor import Sensor, random_charge, simulate
from spike4dgs.generators.sensor_maps import dark_map, gain_map, write_maps
from spike4dgs.generators.worlds import WORLDS, WorldScene

LICENCE = "CC0-1.0"
_POINTS_PER_VIEW = 250  # of the sparse model
_MASK_GROW_PX = 2
_MASK_CHANGE = 0.1  # relative change of radiance that counts as moving light

T = TypeVar("T")
Watch = Callable[[str, Iterable[T], int], Iterator[T]]  # (stage, steps, number of steps) -> the steps, shown


@dataclass
class Maker:
    """Makes one scene below `out`; `watch` shows the progress of the stages.

    >>> Maker(job, Path("data"), watch).make()  # doctest: +SKIP
    """

    job: Job
    out: Path
    watch: Watch[Any]
    seconds: dict[str, float] = field(default_factory=dict)  # wall time of each stage in this process

    def make(self) -> Path:
        """Make or resume the scene, then move it to OUT/ID, over a scene that may be there. Returns OUT/ID."""
        with _alone(self._work.with_name(f"{self.job.id}.lock")):
            self._open_work()
            self._timed("key frames", self._render_keys)
            self._timed("ground truth", self._render_targets)
            self._timed("spikes", self._simulate)
            self._timed("description", self._describe)
            return self._publish()

    def _timed(self, stage: str, work: Callable[[], None]) -> None:
        start = time.perf_counter()
        work()
        self.seconds[stage] = round(time.perf_counter() - start, 2)

    # ------------------------------------------------------------ what everything follows from

    @cached_property
    def world(self) -> WorldScene:
        """The world as this job builds it."""
        return WORLDS[self.job.world].build(self.job.seed, self.job.variant, self.job.seconds)

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras of the profile."""
        p = self.job.profile
        return cameras(self.world, p.width, p.height, p.views)

    @cached_property
    def ticks(self) -> list[int]:
        """Ticks of the key frames."""
        speed = max_image_speed(self.world, self.cameras, self.job.seconds)
        return [int(t) for t in key_ticks(speed, self.job.n_ticks, RATE_HZ, self.job.profile.max_key_px)]

    @property
    def _held_out(self) -> int:
        return self.job.profile.views.index(HELD_OUT_VIEW)

    @property
    def _work(self) -> Path:
        return self.out / ".work" / self.job.id

    @property
    def _scene(self) -> Path:
        return self._work / "scene"

    @cached_property
    def _store(self) -> KeyStore:
        return KeyStore(self._work / "keys")

    @cached_property
    def _versions(self) -> dict[str, str]:
        found = {"mitsuba_variant": str(load_mitsuba().variant())}
        for package in ("spike4dgs", "mitsuba", "drjit", "numba", "numpy", "scipy"):
            try:
                found[package] = version(package)
            except PackageNotFoundError:
                found[package] = "unknown"
        return found

    # ------------------------------------------------------------ stages

    def _open_work(self) -> None:
        """Make the work folder, or keep it if it belongs to the same settings and programs."""
        key = sha256_json({"settings": self.job.settings, "versions": self._versions})
        path = self._work / "settings.json"
        if path.is_file() and read_json(path, "the settings of unfinished work").get("key") != key:
            shutil.rmtree(self._work)
        p, dense = self.job.profile, 4 * self.job.profile.width * self.job.profile.height
        needed = len(p.views) * (self.job.n_ticks * bytes_per_tick(p.width, p.height) + len(self.ticks) * dense)
        self._work.mkdir(parents=True, exist_ok=True)
        if (free := shutil.disk_usage(self._work).free) < needed and not path.is_file():
            expected, found = f"about {needed / 1e9:.1f} GB of free disk space", f"{free / 1e9:.1f} GB"
            raise problem(self.out, expected, found, "free some space or choose a smaller profile")
        write_json(path, {"key": key, "settings": self.job.settings, "versions": self._versions})

    def _render_keys(self) -> None:
        missing = self._store.missing(self.ticks)
        if not missing and self._store.has_background and self._points_file.is_file():
            return
        p = self.job.profile
        renderer = MultiViewRenderer(
            self.world, self.cameras, seed=self.job.seed, spp=p.spp, background_spp=p.background_spp
        )
        for _ in self.watch("background", range(1), 1):
            self._store.set_background(renderer.backgrounds())
            write_json(self._points_file, {"points": _surface_points(renderer).tolist()})
        for tick in self.watch("key frames", missing, len(missing)):
            self._store.write(tick, renderer.keys(tick / RATE_HZ))

    def _render_targets(self) -> None:
        camera = self.cameras[self._held_out]
        targets = [Target(camera.id, tick) for tick in self.job.target_ticks]
        missing = [t for t in targets if not self._mask_file(t).is_file()]  # the mask is written last
        if not missing:
            return
        p = self.job.profile
        renderer = MultiViewRenderer(
            self.world, [camera], seed=self.job.seed + 1, spp=p.target_spp, background_spp=p.target_background_spp
        )
        low, high = self._store.range(self._held_out, self.ticks)
        varies = high - low > _MASK_CHANGE * high
        for target in self.watch("ground truth", missing, len(missing)):
            t_s = target.tick / RATE_HZ
            image, still = renderer.keys(t_s)[0], renderer.backgrounds()[0]
            write_exr(self._scene / f"images/{target.name}.exr", image, target.tick * 1e6 / RATE_HZ)
            write_mask(self._mask_file(target), moving_region(renderer.object_masks(t_s)[0], image, still, varies))

    def _simulate(self) -> None:
        job = self.job
        missing = [v for v, c in enumerate(self.cameras) if not (self._scene / stream_name(c.id)).is_file()]
        for view in self.watch("spikes", missing, len(missing)):
            camera = self.cameras[view]
            size = camera.height, camera.width
            gain = gain_map(*size, job.seed, camera.id) if job.gain_map else None
            dark = dark_map(*size, job.seed, camera.id) if job.dark_map else None
            write_maps(self._scene / f"truth/{camera.id}.npz", {"gain": gain, "dark": dark})
            charge = random_charge(*size, [job.seed, job.variant, *f"{job.world} {camera.id}".encode()])
            keys = self._store.view(view, self.ticks)
            with SpikeWriter(self._scene / stream_name(camera.id), camera.width, camera.height) as writer:
                for packed in simulate(keys, self.ticks, job.n_ticks, Sensor(gain=gain, dark=dark), charge):
                    writer.write(packed)

    def _describe(self) -> None:
        job, held_out = self.job, self.cameras[self._held_out].id
        for part in self._scene.rglob(".*.part*"):  # what a killed process left behind
            part.unlink()
        finish_scene(
            self._scene,
            SceneDescription(
                id=job.id,
                title=f"{WORLDS[job.world].title} (variant {job.variant})",
                licence=LICENCE,
                cameras=self.cameras,
                train=tuple(c.id for c in self.cameras if c.id != held_out),
                test=(held_out,),
                rate_hz=float(RATE_HZ),
                n_ticks=job.n_ticks,
                radiance_gain=Sensor().radiance_gain,
                targets=tuple(Target(held_out, tick) for tick in job.target_ticks),
                sensor={
                    "model": "integrate-and-fire/1",
                    "rows_bottom_up": True,
                    "gain_map": job.gain_map,
                    "dark_map": job.dark_map,
                },
                source={
                    **job.settings,
                    "key_spacing_ticks": self.ticks[1],
                    "notes": dict(self.world.notes),
                    "versions": self._versions,
                },
                points=np.array(read_json(self._points_file, "surface points")["points"], dtype=np.float64),
            ),
        )

    def _publish(self) -> Path:
        final = self.out / self.job.id
        old = self._work / "replaced"
        if final.exists():
            os.rename(final, old)
        os.rename(self._scene, final)
        shutil.rmtree(self._work)
        return final

    @property
    def _points_file(self) -> Path:
        return self._work / "points.json"

    def _mask_file(self, target: Target) -> Path:
        return self._scene / f"masks/{target.name}.png"


def moving_region(
    object_mask: NDArray[np.bool_], image: NDArray[np.float32], still: NDArray[np.float32], varies: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """The moving region [H, W] of a ground-truth image: where the `*_dynamic` metrics look.

    Pixels that see a moving thing, grown by 2 px, and pixels whose light it changes: its shadow, or its light on other
    things, where the radiance differs by more than 10 % from the background `still` and also `varies` that much over
    the clip (the shadow of a disc that turns in place does not). Specks under 2 px are dropped.
    """
    lit = (np.abs(image - still) > _MASK_CHANGE * still) & varies
    grown = binary_dilation(object_mask, np.ones((3, 3)), iterations=_MASK_GROW_PX)
    return np.asarray(grown | binary_opening(lit, np.ones((2, 2))))


def _surface_points(renderer: MultiViewRenderer) -> NDArray[np.float64]:
    """Points [N, 3] on still surfaces at t = 0: a coarse grid of every view's pixels, for the sparse model."""
    depths, moving = renderer.depths(0.0), renderer.object_masks(0.0)
    found = []
    for camera, depth, mask in zip(renderer.cameras, depths, moving, strict=True):
        step = max(1, round(np.sqrt(depth.size / _POINTS_PER_VIEW)))
        v, u = (g.ravel() for g in np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step])
        keep = np.isfinite(depth[v, u]) & ~mask[v, u]
        uv = np.stack([u[keep], v[keep]], axis=1) + 0.5
        found.append(camera.unproject(uv, depth[v, u][keep].astype(np.float64)))
    return np.concatenate(found)


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Keep a second process off the same scene. The system lifts the lock when the process ends, however it ends."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w") as f:
        try:
            fcntl.flock(f, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise problem(path.stem, "a scene that nobody else makes", "a run in progress", "wait for it") from None
        yield
    path.unlink(missing_ok=True)  # reached only where the scene is done
    if not any(path.parent.iterdir()):
        path.parent.rmdir()
