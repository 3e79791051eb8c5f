"""Rendering for an array that moves: at each time every pixel is traced, by cameras where they are then.

The frame of the scene is that of the array, in which its cameras stand still and all that they see moves. So there is
no background to reuse, and no light to reuse: each time has a renderer of its own, with random numbers of its own.
Keys between two coarse ones hold only the pixels whose motion is too fast for the coarse ones, as of an array that
stands still; the others are interpolated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.render import MultiViewRenderer, StaticViews
from spike4dgs.generators.rig import ArrayPath
from spike4dgs.generators.worlds import WorldScene

_STEP_S = 5e-6  # over which image speed is measured
_FAR_M = 1e6  # where there is no surface: only a turn of the array moves it
_SEEDS = 1_000_003  # between those of two tenths of a microsecond


class _PosedRenderer(MultiViewRenderer):
    """Renders every pixel of cameras at one pose of the array."""

    def flow(self, t_s: float, dt_s: float, later: Sequence[Camera]) -> np.ndarray:
        """Return the motion [C, H, W, 2] float64, px, of the pixels' surface points that move on for `dt_s` seconds.

        It ends in the images of the cameras `later`. Where there is no surface, the point is very far away.
        """
        snapshot = self._snapshot(t_s)
        origins, directions, _ = self._rays
        distance = np.where(snapshot.seen, snapshot.hits.distance, self._static_hits[0]).astype(np.float64)
        points = origins + directions * np.where(np.isfinite(distance), distance, _FAR_M)[:, None]
        seen = np.flatnonzero(snapshot.seen)
        points[seen] = self._moved(seen, snapshot, t_s, t_s + dt_s)
        pixels, found = np.arange(len(points)), np.zeros((len(points), 2))
        for view, _, mine in self._by_view(pixels):
            found[mine] = later[view].project(points[mine])[0] - self._centres(pixels[mine], view)
        return found.reshape(*self.shape, 2)

    def values(self, given: np.ndarray, t_s: float) -> np.ndarray:
        """Return the radiance [K] of the given pixels [C, H, W]."""
        return self._traced_at(np.flatnonzero(given), t_s)

    def sparse(self, kind: str, given: np.ndarray, values: np.ndarray) -> dict[str, np.ndarray]:
        """Return the arrays of given pixels [C, H, W] for `KeyStore`; `kind` "mean_": their means over the tick."""
        return self._sparse(f"{kind}given", f"{kind}values", given, values)


class MovingArrayRenderer:
    """Renders a world like a `MultiViewRenderer`, by the cameras of an array that moves.

    Static views are those at t = 0, with the noise of a key: no image is made of them.
    """

    def __init__(
        self,
        world: WorldScene,
        cameras: Sequence[Camera],
        *,
        path: ArrayPath,
        seed: int,
        spp: int,
        static: StaticViews | None = None,
        **settings: Any,
    ) -> None:
        """Load the world; see `MultiViewRenderer`. `cameras` are those of the array at t = 0."""
        self.world, self.cameras, self.path = world, tuple(cameras), path
        own = settings | {"spp": spp, "background_spp": spp, "whole_frames": True}

        @lru_cache(maxsize=2)
        def posed(t_s: float) -> _PosedRenderer:
            own_seed = (seed + _SEEDS * round(t_s * 1e7)) % (1 << 31)
            return _PosedRenderer(world, path.posed(cameras, t_s), seed=own_seed, **own)

        self._at = posed

    def static_at(self, pixels: np.ndarray, background: bool = True) -> tuple[np.ndarray, ...]:
        """Return the static views at flat pixels, as `MultiViewRenderer.static_at`."""
        return self._at(0.0).static_at(pixels, background)

    def keys(self, t_s: float) -> np.ndarray:
        """Return the views at `t_s`."""
        return self._at(t_s).keys(t_s)

    crn_frames = keys

    def reference_frames(self, t_s: float, spp: int) -> np.ndarray:
        """Return the views at `t_s` by Mitsuba's own render loop."""
        return self._at(t_s).reference_frames(t_s, spp)

    def key_arrays(self, tick: int, plan: KeyPlan) -> dict[str, np.ndarray]:
        """Return the arrays of a tick as `MultiViewRenderer.key_arrays`; coarse keys give all pixels."""
        t_s, level, now = tick / plan.rate_hz, plan.level(tick), self._at(tick / plan.rate_hz)
        given = self.traced(t_s) if level == 0 else self._fast(t_s, plan.chain[level - 1], plan)
        arrays = now.sparse("", given, now.values(given, t_s))
        if plan.sub_ticks > 1 and tick < plan.n_ticks:
            fast = self._fast(t_s + 0.5 / plan.rate_hz, 1, plan)
            instants = t_s + (np.arange(plan.sub_ticks) + 0.5) / plan.sub_ticks / plan.rate_hz
            means = np.mean([self._at(instant).values(fast, instant) for instant in instants], axis=0)
            arrays |= now.sparse("mean_", fast, means)
        return arrays

    def traced(self, t_s: float) -> np.ndarray:
        """Return [C, H, W] bool: the pixels that move, which are all."""
        return np.ones(self._at(t_s).shape, bool)

    moving_masks = traced

    def object_masks(self, t_s: float) -> np.ndarray:
        """Return [C, H, W] bool: the ray through the pixel's centre meets an object first that moves in the world."""
        return self._at(t_s).object_masks(t_s)

    def depths(self, t_s: float) -> np.ndarray:
        """Return float32 [C, H, W]: z in camera coordinates, as `MultiViewRenderer.depths`."""
        return self._at(t_s).depths(t_s)

    def geometry(self, t_s: float, dt_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return depth, object numbers and optical flow as `MultiViewRenderer.geometry`.

        Number 0 stands still in the world; it has a flow all the same.
        """
        now = self._at(t_s)
        depth, numbers, _ = now.geometry(t_s, dt_s)
        flow = now.flow(t_s, dt_s, self.path.posed(self.cameras, t_s + dt_s))
        return depth, numbers, flow.astype(np.float32)

    def speeds(self, t_s: float) -> np.ndarray:
        """Return float32 [C, H, W], px/s: by how fast the images of points and shadows move, at most, at a pixel.

        The sum of the fastest motion in the world within 3 px and of what the array's motion makes of the pixel's own
        point, not of its neighbours'.
        """
        now, later = self._at(t_s), self.path.posed(self.cameras, t_s + _STEP_S)
        carried = np.linalg.norm(now.flow(t_s, 0.0, later), axis=-1) / _STEP_S
        return np.asarray(now.speeds(t_s) + carried, dtype=np.float32)

    def _fast(self, t_s: float, ticks: int, plan: KeyPlan) -> np.ndarray:
        """Return [C, H, W] bool: the pixels that move by more than the plan's motion within some ticks."""
        return self.speeds(t_s) * (ticks / plan.rate_hz) > plan.max_px


def along(path: ArrayPath | None) -> Callable[..., MultiViewRenderer | MovingArrayRenderer]:
    """Return what makes the renderer of whole paths for an array that moves along a path; None: it stands still."""
    return partial(MovingArrayRenderer, path=path) if path else MultiViewRenderer
