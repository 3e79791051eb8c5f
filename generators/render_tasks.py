"""The rendering of a scene in units for any process: each is a function of a few arguments and returns arrays.

A task object is sent to its worker once and is then called for one chunk of ticks after another; it keeps what it has
loaded (the world, Mitsuba's scene) between calls. It neither reads nor writes files, so a worker on another machine
needs no common file system. `render_static` runs those of the background and keeps what is done.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.runs.executors import Run, chunked, here
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.generators.physics import true_cameras
from spike4dgs.generators.profiles import HELD_OUT_VIEW, RATE_HZ, TARGET_EVERY, Job
from spike4dgs.generators.rendering.image_motion import KeyPlan, key_plan
from spike4dgs.generators.rendering.keyframes import finite, read_arrays, write_arrays
from spike4dgs.generators.rendering.lights.layers import Renderer, path_renderer
from spike4dgs.generators.rendering.like_surfaces import join_soft
from spike4dgs.generators.rendering.render import SoftStatic, StaticViews, anchor_s
from spike4dgs.generators.rig import ArrayPath, array_path, cameras
from spike4dgs.generators.worlds import WORLDS, WorldScene, build_at

_POINTS_PER_VIEW = 250  # of the sparse model
_PIXELS = 1 << 15  # of a range of the background, or more: a second of work or longer
_MOST_PARTS = 32
_OF_SPLIT = ("soft_static", "maps_of")  # arguments that renderers of whole paths have not
Watch = Callable[[str, Iterable[Any], int], Iterator[Any]]


def recorded_job(source: Mapping[str, Any], root: Path) -> Job | None:
    """Return the job whose `settings` are the `source` of ROOT/scene.json; None where no world here made the scene.

    Raises UserError where settings lack or are of another kind.
    """
    if source["kind"] != "mitsuba" or not isinstance(world := source.get("world"), str) or world not in WORLDS:
        return None
    try:
        return Job.from_settings(source)
    except (KeyError, TypeError, ValueError) as e:
        where = f"{root / 'scene.json'}, source"
        raise problem(where, f"the settings of {world}", repr(e)[:200], "make it again") from None


@lru_cache(maxsize=1)
def world_of(job: Job) -> WorldScene:
    """Return the world as a job builds it."""
    return build_at(WORLDS[job.world], job.seed, job.variant, job.seconds, job.physics.speed)


@lru_cache(maxsize=1)
def cameras_of(job: Job) -> tuple[Camera, ...]:
    """Return the true cameras of a job's profile, each with its own lens where lenses differ."""
    p = job.profile
    return true_cameras(cameras(world_of(job), p.width, p.height, p.views), p.views, job.physics, job.seed)


@lru_cache(maxsize=1)
def plan_of(job: Job) -> KeyPlan:
    """Return the plan of a job: which pixels are rendered at which ticks."""
    args = world_of(job), cameras_of(job), job.n_ticks, RATE_HZ, job.profile.max_key_px
    return key_plan(*args, adaptive=job.adaptive, sub_ticks=job.sub_ticks, path=path_of(job))


@lru_cache(maxsize=1)
def path_of(job: Job) -> ArrayPath | None:
    """Return the path of a job's array; None where it stands still."""
    return array_path(world_of(job).rig, job.physics, [job.seed, job.variant, *job.world.encode()])


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


@dataclass(frozen=True, eq=False)
class RenderSoft(_Task):
    """Renders soft light of the background for streams or ground truth. Called with (first, end) of flat pixels."""

    truth: bool

    @cached_property
    def _renderer(self) -> Any:
        return renderer_of(self.job, cameras_of(self.job), truth=self.truth)

    def __call__(self, part: tuple[int, int]) -> tuple[NDArray[np.float32], ...]:
        """Return the arrays of the pixels; see `split_render.SplitRenderer.soft_at`."""
        return self._renderer.soft_at(np.arange(*part))  # type: ignore[no-any-return]


@dataclass(frozen=True, eq=False)
class RenderStatic(_Task):
    """Renders the background for streams or ground truth. Called with (first, end) of flat pixels."""

    truth: bool
    background: bool  # False: only the rendering with the random numbers of keys
    soft: SoftStatic | None

    @cached_property
    def _renderer(self) -> Renderer:
        return renderer_of(self.job, cameras_of(self.job), truth=self.truth, soft_static=self.soft)

    def __call__(self, part: tuple[int, int]) -> tuple[NDArray[np.float32], ...]:
        """Return the pixels [K, 3] of the images of `StaticViews`."""
        return self._renderer.static_at(np.arange(*part), self.background)


@dataclass(frozen=True, eq=False)
class SurfacePoints(_Task):
    """Finds points on static surfaces at t = 0, a coarse grid of every view's pixels; ignores its argument."""

    def __call__(self, part: object) -> NDArray[np.float64]:
        """Return the points [N, 3] for the sparse model."""
        renderer = renderer_of(self.job, cameras_of(self.job), truth=False)
        depths, moving = renderer.depths(0.0), renderer.object_masks(0.0)
        found = []
        for camera, depth, mask in zip(renderer.cameras, depths, moving, strict=True):
            step = max(1, round(np.sqrt(depth.size / _POINTS_PER_VIEW)))
            v, u = (g.ravel() for g in np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step])
            keep = np.isfinite(depth[v, u]) & ~mask[v, u]
            uv = np.stack([u[keep], v[keep]], axis=1) + 0.5
            found.append(camera.unproject(uv, depth[v, u][keep].astype(np.float64)))
        return np.concatenate(found)


@dataclass(frozen=True, eq=False)
class RenderKeys(_Task):
    """Renders key frames. Called with ticks; returns a pair (tick, arrays for `KeyStore.put`) for each."""

    static: StaticViews

    @cached_property
    def _renderer(self) -> Renderer:
        return renderer_of(self.job, cameras_of(self.job), truth=False, static=self.static)

    def __call__(self, ticks: Sequence[int]) -> list[tuple[int, dict[str, NDArray[Any]]]]:
        """Return the keys of `ticks`."""
        name, plan, render = f"{self.job.world}-{self.job.variant}, key frame", plan_of(self.job), self._renderer
        return [(t, finite(lambda tick: render.key_arrays(tick, plan), t, f"{name} {t}")) for t in ticks]


def key_chunks(job: Job, ticks: Sequence[int]) -> list[list[int]]:
    """Return runs of ticks that share work: with maps of soft light, those of at least two intervals between maps."""
    if job.profile.soft is None:
        return chunked(ticks)
    interval = anchor_s(world_of(job), cameras_of(job), job.profile.soft.anchor_px) * RATE_HZ
    length = interval * max(2, int(job.n_ticks / interval) // 8)
    return [list(run) for _, run in groupby(ticks, lambda tick: int(tick / length))]


class Truth(NamedTuple):
    """Ground truth of one camera at one tick."""

    view: int
    tick: int
    rgb: NDArray[np.float32]  # [H, W, 3]
    mask: NDArray[np.bool_]  # [H, W] where a moving object is visible, also in a mirror
    depth: NDArray[np.float32]  # [H, W]
    ids: NDArray[np.uint32]  # [H, W]
    flow: NDArray[np.float32]  # [H, W, 2] px within the next millisecond


@dataclass(frozen=True, eq=False)
class RenderTargets(_Task):
    """Renders ground truth. Called with ticks; returns it for the held-out camera, at sparse ticks for all cameras."""

    static: StaticViews  # with the noise of ground truth

    @cached_property
    def _every_view(self) -> Renderer:
        return renderer_of(self.job, cameras_of(self.job), truth=True, static=self.static)

    @cached_property
    def _held_out(self) -> Renderer:
        view = held_out_view(self.job)
        static = self.static.views(range(view, len(self.static.background), len(cameras_of(self.job))))
        views = cameras_of(self.job)[view : view + 1]
        return renderer_of(self.job, views, truth=True, static=static, maps_of=lambda: self._every_view)

    def __call__(self, ticks: Sequence[int]) -> list[Truth]:
        """Return the ground truth of `ticks`."""
        return [truth for tick in ticks for truth in self._at(tick)]

    def _at(self, tick: int) -> list[Truth]:
        t_s, everywhere = tick / RATE_HZ, tick in self.job.sparse_ticks
        renderer = self._every_view if everywhere else self._held_out
        views = range(len(cameras_of(self.job))) if everywhere else [held_out_view(self.job)]
        keys = finite(renderer.keys, t_s, f"{self.job.world}-{self.job.variant}, target {tick}")
        images = (keys, renderer.moving_masks(t_s), *renderer.geometry(t_s, TARGET_EVERY / RATE_HZ))
        return [Truth(view, tick, *one) for view, *one in zip(views, *images, strict=True)]


def renderer_of(job: Job, views: Sequence[Camera], *, truth: bool, seed: int | None = None, **others: Any) -> Renderer:
    """Return the renderer of streams or of ground truth, of no common random number. `others` go to the renderer."""
    p = job.profile
    own = {
        "seed": job.render_seed + truth if seed is None else seed,
        "spp": p.target_spp if truth else p.spp,
        "background_spp": max(p.background_spp, p.target_spp) if truth else p.background_spp,
        "color": truth,
        "whole_frames": job.whole_frames and not truth,
        "psf_px": job.physics.psf_px,
    } | others
    if (soft := p.target_soft if truth else p.soft) is None:
        own = {k: v for k, v in own.items() if k not in _OF_SPLIT} | {"path": path_of(job)}
        return path_renderer(world_of(job), views, **own)
    from spike4dgs.generators.rendering.split_render import SplitRenderer  # it needs compiled kernels

    anchors_s = anchor_s(world_of(job), cameras_of(job), soft.anchor_px)
    return SplitRenderer(world_of(job), views, soft=soft, anchors_s=anchors_s, **own)


class StaticParts(NamedTuple):
    """Images and points that are rendered once for a scene."""

    views: StaticViews
    truth: StaticViews  # with the noise of ground truth; its background is the same one where paths are whole
    points: NDArray[np.float64]  # [N, 3] on static surfaces, for the sparse model


def unseen(stage: str, steps: Iterable[Any], total: int) -> Iterator[Any]:
    """Return the steps; show nothing."""
    return iter(steps)


def render_static(job: Job, folder: Path, run: Run = here, watch: Watch = unseen) -> StaticParts:
    """Return the static parts of a scene; `folder` keeps what is done, and a killed call resumes from it."""
    folder.mkdir(parents=True, exist_ok=True)
    views = _views(job, False, None, folder, run, watch)
    truth = _views(job, True, views, folder, run, watch)
    (points,) = run(SurfacePoints(job), [None])
    return StaticParts(views, truth, points)


def _views(job: Job, truth: bool, other: StaticViews | None, folder: Path, run: Run, watch: Watch) -> StaticViews:
    """Return the static views of streams or of ground truth; paths are whole: with the background of `other`."""
    cameras, p = cameras_of(job), job.profile
    n = int(np.prod(shape := (len(cameras) * len(world_of(job).layers), p.height, p.width)))
    bounds = np.linspace(0, n, min(max(n // _PIXELS, 2), _MOST_PARTS) + 1).astype(int).tolist()
    ranges = list(zip(bounds[:-1], bounds[1:], strict=True))

    def rendered(task: Any, stage: str) -> list[tuple[Any, ...]]:
        """Return the arrays of all ranges."""
        files = [folder / f"{stage}-{k:02d}.npz" for k in range(len(ranges))]
        missing = [k for k, file in enumerate(files) if not file.is_file()]

        def steps() -> Iterator[int]:
            for k, arrays in zip(missing, run(task, [ranges[k] for k in missing]), strict=True):
                write_arrays(files[k], {f"{number}": a for number, a in enumerate(arrays)})
                yield k

        if missing:
            for _ in watch(stage, steps(), len(missing)):
                pass
        return [tuple(read_arrays(file).values()) for file in files]

    which = "background of the truth" if truth else "background"
    sampling, soft = (p.target_soft if truth else p.soft), None
    if sampling is not None:
        soft = join_soft(rendered(RenderSoft(job, truth), f"soft {which}"), cameras, sampling.sigma_px)
    own = other is None or soft is not None
    found = zip(*rendered(RenderStatic(job, truth, own, soft), which), strict=True)
    images = [(a := np.concatenate(parts)).reshape(*shape, *a.shape[1:]) for parts in found]
    if soft is not None:
        return StaticViews(images[0], images[0], soft, images[1])
    if other is None:
        return StaticViews(images[0], images[1])
    return StaticViews(other.background, images[0])
