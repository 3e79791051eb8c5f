"""The rendering of a scene in units for any process: each is a function of a few arguments and returns arrays.

A task object is sent to its worker once and is then called for one chunk of ticks after another; it keeps what it has
loaded (the world, Mitsuba's scene) between calls. It neither reads nor writes files, so a worker on another machine
needs no common file system.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.generators.physics import from_settings, true_cameras
from spike4dgs.generators.profiles import HELD_OUT_VIEW, RATE_HZ, TARGET_EVERY, Job, Profile
from spike4dgs.generators.rendering.image_motion import KeyPlan, key_plan
from spike4dgs.generators.rendering.render import MultiViewRenderer, StaticViews
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import WORLDS, WorldScene

_POINTS_PER_VIEW = 250  # of the sparse model


def recorded_job(source: Mapping[str, Any]) -> Job | None:
    """Return the job whose `settings` are in the `source` of a scene.json.

    None for a scene that no world of this installation made.
    """
    if source["kind"] != "mitsuba" or source["world"] not in WORLDS:
        return None
    same = ("gain_map", "dark_map", "shot_noise", "sub_ticks", "whole_frames", "noise")
    return Job(
        source["world"],
        source["variant"],
        int(source["seed"]),
        source["profile"],
        Profile(**{**source["sampling"], "views": tuple(source["sampling"]["views"])}),
        source["seconds"],
        adaptive=source.get("adaptive_keys", True),
        physics=from_settings(source.get("physics", {})),
        **{name: source[name] for name in same if name in source},
    )


@lru_cache(maxsize=1)
def world_of(job: Job) -> WorldScene:
    """Return the world as a job builds it."""
    return WORLDS[job.world].build(job.seed, job.variant, job.seconds)


@lru_cache(maxsize=1)
def cameras_of(job: Job) -> tuple[Camera, ...]:
    """Return the true cameras of a job's profile, each with its own lens where lenses differ."""
    p = job.profile
    return true_cameras(cameras(world_of(job), p.width, p.height, p.views), p.views, job.physics, job.seed)


@lru_cache(maxsize=1)
def plan_of(job: Job) -> KeyPlan:
    """Return the plan of a job: which pixels are rendered at which ticks."""
    motion = {"adaptive": job.adaptive, "sub_ticks": job.sub_ticks}
    return key_plan(world_of(job), cameras_of(job), job.n_ticks, RATE_HZ, job.profile.max_key_px, **motion)


def held_out_view(job: Job) -> int:
    """Return the index of the held-out camera among the job's."""
    return job.profile.views.index(HELD_OUT_VIEW)


@dataclass(frozen=True, eq=False)
class _Task:
    """A task: its fields are sent to the worker, its cached values are not."""

    job: Job

    def __getstate__(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)


class StaticParts(NamedTuple):
    """Images and points that are rendered once for a scene."""

    views: StaticViews
    target_first: NDArray[np.float32]  # [C, H, W, 3], the static background with the noise of ground truth
    points: NDArray[np.float64]  # [N, 3] on static surfaces, for the sparse model


class StaticPart(NamedTuple):
    """A part of `StaticParts`: samples of the background, or some pixels with the noise of ground truth."""

    rgb: NDArray[np.float32]  # [C, H, W, 3] or [K, 3]
    points: NDArray[np.float64] | None  # of the first part


@dataclass(frozen=True, eq=False)
class RenderStatic(_Task):
    """Renders the static background, in parts of as many paths each; called with the number of one."""

    @property
    def parts(self) -> range:
        """The numbers of all parts: those of the background come first."""
        return range(self._backgrounds + self._truths)

    def join(self, parts: Iterable[StaticPart]) -> StaticParts:
        """Return the static parts of the scene from all parts, in order."""
        first, points, truth = None, None, []
        for number, part in enumerate(parts):
            if first is None:
                first, points, total = part.rgb, part.points, part.rgb.astype(np.float64)
            elif number < self._backgrounds:
                total += part.rgb
            else:
                truth.append(part.rgb)
        assert first is not None and points is not None  # there is a part of the background
        background = (total / self._backgrounds).astype(np.float32)
        return StaticParts(StaticViews(background, first), np.concatenate(truth).reshape(first.shape), points)

    @property
    def _backgrounds(self) -> int:
        return self.job.profile.background_spp // self.job.profile.spp

    @property
    def _truths(self) -> int:
        return max(1, self.job.profile.target_spp // self.job.profile.spp)

    @cached_property
    def _renderer(self) -> MultiViewRenderer:
        p = self.job.profile
        return MultiViewRenderer(
            world_of(self.job),
            cameras_of(self.job),
            seed=self.job.render_seed,
            spp=p.spp,
            background_spp=p.background_spp,
            psf_px=self.job.physics.psf_px,
        )

    @cached_property
    def _truth(self) -> MultiViewRenderer:
        return _target_renderer(self.job, cameras_of(self.job), None)

    def __call__(self, number: int) -> StaticPart:
        """Return one part."""
        if number < self._backgrounds:
            points = _surface_points(self._renderer) if number == 0 else None
            return StaticPart(self._renderer.background_sample(number), points)
        pixels = np.arange(int(np.prod(self._truth.shape)))
        return StaticPart(
            self._truth.static_pixels(np.array_split(pixels, self._truths)[number - self._backgrounds]), None
        )


@dataclass(frozen=True, eq=False)
class RenderKeys(_Task):
    """Renders key frames. Called with ticks; returns a pair (tick, arrays for `KeyStore.put`) for each."""

    static: StaticViews

    @cached_property
    def _renderer(self) -> MultiViewRenderer:
        p, job = self.job.profile, self.job
        return MultiViewRenderer(
            world_of(job),
            cameras_of(job),
            seed=job.render_seed,
            spp=p.spp,
            background_spp=p.background_spp,
            static=self.static,
            whole_frames=job.whole_frames,
            psf_px=job.physics.psf_px,
        )

    def __call__(self, ticks: Sequence[int]) -> list[tuple[int, dict[str, NDArray[Any]]]]:
        """Return the keys of `ticks`."""
        return [(tick, self._renderer.key_arrays(tick, plan_of(self.job))) for tick in ticks]


class Truth(NamedTuple):
    """Ground truth of one camera at one tick."""

    view: int
    tick: int
    rgb: NDArray[np.float32]  # [H, W, 3]
    mask: NDArray[np.bool_]  # [H, W] where a moving object is visible
    depth: NDArray[np.float32]  # [H, W]
    ids: NDArray[np.uint32]  # [H, W]
    flow: NDArray[np.float32]  # [H, W, 2] px within the next millisecond


@dataclass(frozen=True, eq=False)
class RenderTargets(_Task):
    """Renders ground truth. Called with ticks; returns it for the held-out camera, at sparse ticks for all cameras."""

    static: StaticViews  # its first part has the noise of ground truth

    @cached_property
    def _every_view(self) -> MultiViewRenderer:
        return _target_renderer(self.job, cameras_of(self.job), self.static)

    @cached_property
    def _held_out(self) -> MultiViewRenderer:
        view = held_out_view(self.job)
        return _target_renderer(self.job, cameras_of(self.job)[view : view + 1], self.static.views([view]))

    def __call__(self, ticks: Sequence[int]) -> list[Truth]:
        """Return the ground truth of `ticks`."""
        return [truth for tick in ticks for truth in self._at(tick)]

    def _at(self, tick: int) -> list[Truth]:
        t_s, everywhere = tick / RATE_HZ, tick in self.job.sparse_ticks
        renderer = self._every_view if everywhere else self._held_out
        views = range(len(cameras_of(self.job))) if everywhere else [held_out_view(self.job)]
        images = (renderer.keys(t_s), renderer.object_masks(t_s), *renderer.geometry(t_s, TARGET_EVERY / RATE_HZ))
        return [Truth(view, tick, *one) for view, *one in zip(views, *images, strict=True)]


def _target_renderer(job: Job, views: Sequence[Camera], static: StaticViews | None) -> MultiViewRenderer:
    """Return a renderer with other random numbers than the keys', so that streams and truth do not share noise."""
    p = job.profile
    background_spp = max(p.background_spp, p.target_spp)
    return MultiViewRenderer(
        world_of(job),
        views,
        seed=job.render_seed + 1,
        spp=p.target_spp,
        background_spp=background_spp,
        color=True,
        static=static,
        psf_px=job.physics.psf_px,
    )


def _surface_points(renderer: MultiViewRenderer) -> NDArray[np.float64]:
    """Return points [N, 3] on static surfaces at t = 0, a coarse grid of every view's pixels, for the sparse model."""
    depths, moving = renderer.depths(0.0), renderer.object_masks(0.0)
    found = []
    for camera, depth, mask in zip(renderer.cameras, depths, moving, strict=True):
        step = max(1, round(np.sqrt(depth.size / _POINTS_PER_VIEW)))
        v, u = (g.ravel() for g in np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step])
        keep = np.isfinite(depth[v, u]) & ~mask[v, u]
        uv = np.stack([u[keep], v[keep]], axis=1) + 0.5
        found.append(camera.unproject(uv, depth[v, u][keep].astype(np.float64)))
    return np.concatenate(found)
