"""Exact motion of objects across the image, from geometry, and the key frames that it requires."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.generators.rendering.mitsuba_scene import Hits
from spike4dgs.generators.rig import ArrayPath
from spike4dgs.generators.worlds import WorldScene

_STEP_S = 1e-6  # short against every motion here, long against float64 round-off of metres
COARSE_PX = 2.5  # largest motion between two coarse keys; `visibility` grows moving objects by more, 3 px
_MOST_SUB_TICKS = 8
_GRID = 9  # points each way
_NARROW_PX = 1.55  # a disc 2**0.5 px wide has a pixel's centre wherever it is; coarse meshes of one are 8 % narrower


def max_image_speed(
    world: WorldScene,
    cameras: Sequence[Camera],
    duration_s: float,
    samples: int = 33,
    path: ArrayPath | None = None,
) -> float:
    """Return the speed in px/s of the fastest visible image point over all views and `samples` times of the clip.

    Exact at those times from geometry: every vertex of the moving meshes is projected at t and a microsecond later,
    rotation included. What is faster between them for a moment is missed. Occlusion is ignored, so the result is an
    upper bound at those times, reached wherever that vertex is visible. Images in mirrors and panes count as visible
    too. Where the array moves along a `path`, so does what stands still at the near end of the world's depth range.
    """
    fastest = 0.0
    for t in np.linspace(0.0, duration_s, samples):
        points = world.moving_points(t), world.moving_points(t + _STEP_S)
        before, after = (np.concatenate([p, *(mirrored(p, plane) for plane in world.mirrors)]) for p in points)
        now, then = (path.posed(cameras, at) if path else cameras for at in (t, t + _STEP_S))
        for camera, later in zip(now, then, strict=True):
            near = _near_points(camera, world.depth_range[0]) if path else before[:0]
            uv, z = camera.project(np.concatenate([before, near]))
            uv_after, _ = later.project(np.concatenate([after, near]))
            seen = (z > 0) & (uv > 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
            speed = np.linalg.norm(uv_after - uv, axis=1)[seen] / _STEP_S
            fastest = max(fastest, float(speed.max(initial=0.0)))
    return fastest


def _near_points(camera: Camera, z: float) -> np.ndarray:
    """Return points [N, 3] at a depth, all over a camera's image."""
    shares = np.linspace(0.01, 0.99, _GRID)
    u, v = (g.ravel() for g in np.meshgrid(shares * camera.width, shares * camera.height))
    return camera.unproject(np.stack([u, v], axis=1), np.full(len(u), z))


def mirrored(points: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Return the mirror images of points [N, 3] in planes [4] or [N, 4] (unit normal n, and n.p of its points p)."""
    n = planes[..., :3]
    return np.asarray(points - 2 * ((points * n).sum(-1) - planes[..., 3])[..., None] * n)


def imaged(points: np.ndarray, planes: Sequence[np.ndarray]) -> np.ndarray:
    """Return where points [N, 3] seem to be that rays meet after reflection at each of `planes` [N, 4] in turn."""
    for plane in reversed(planes):
        points = mirrored(points, plane)
    return points


def carried(world: WorldScene, hits: Hits, points: np.ndarray, from_s: float, to_s: float) -> np.ndarray:
    """Return positions [N, 3] at `to_s` of the moving surface points [N, 3] that `hits` found at `from_s`; float64."""
    out = points.astype(np.float64)
    before, after = world.poses(from_s), world.poses(to_s)
    for number, name in enumerate(world.instances):
        mine = hits.number == number
        if mine.any():
            move = after[name] @ np.linalg.inv(before[name])
            out[mine] = points[mine] @ move[:3, :3].T + move[:3, 3]
    for number, surface in enumerate(world.deforming.values(), start=len(world.instances)):
        mine = hits.number == number
        if mine.any():
            corners = surface.part.mesh.faces[hits.face[mine]]  # [K, 3]
            u, v = hits.uv[mine].T
            weights = np.stack([1 - u - v, u, v], axis=1)
            shift = surface.vertices(to_s)[corners] - surface.vertices(from_s)[corners]  # [K, 3 corners, xyz]
            out[mine] = points[mine] + np.einsum("kc,kcx->kx", weights, shift)
    return out


def object_numbers(world: WorldScene, hits: Hits) -> np.ndarray:
    """Return the numbers, from 1, of the objects that were hit; each body of a surface is an object."""
    first = len(world.instances) + 1
    numbers = hits.number.astype(np.int64) + 1
    for k, surface in enumerate(world.deforming.values(), start=len(world.instances)):
        mine = hits.number == k
        bodies = np.zeros(len(surface.part.mesh.faces), np.int64) if surface.bodies is None else surface.bodies
        numbers[mine] = first + bodies[hits.face[mine]]
        first += int(bodies.max()) + 1
    return numbers


def narrow_corners(
    world: WorldScene, cameras: Sequence[Camera], from_s: float, to_s: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where the corners of bodies are at `from_s` that may lie between the centres of pixels.

    Flat pixels [K] of the views, distances [K] from the cameras, and the motion [K] across the image until `to_s`, px.
    """
    pixels, distances, motions = [np.zeros(0, np.int64)], [np.zeros(0)], [np.zeros(0)]
    for surface in (s for s in world.deforming.values() if s.bodies is not None):
        now, later = surface.vertices(from_s), surface.vertices(to_s)
        for view, camera in enumerate(cameras):
            uv, z = camera.project(now)
            inside = (z > 0) & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
            some = np.flatnonzero(inside & (surface.corner_widths * camera.fx < _NARROW_PX * z))
            if len(some):
                column, row = uv[some].astype(np.int64).T
                pixels.append((view * camera.height + row) * camera.width + column)
                distances.append(np.linalg.norm(now[some] - camera.center, axis=1))
                motions.append(np.linalg.norm(camera.project(later[some])[0] - uv[some], axis=1))
    return np.concatenate(pixels), np.concatenate(distances), np.concatenate(motions)


@dataclass(frozen=True)
class KeyPlan:
    """The ticks at which key frames are rendered, and which pixels of them.

    Attributes:
        n_ticks, rate_hz: length of the clip and ticks per second.
        max_px: largest motion of an image point between two of its keys, at the speeds that `max_image_speed` finds.
        chain: spacings in ticks, coarsest first, each a divisor of the one before. Keys at multiples of `chain[0]` are
            whole. At other multiples of `chain[k]` only pixels are traced whose motion over `chain[k - 1]` ticks is
            more than `max_px`; the others are interpolated from the coarser keys.
        sub_ticks: number of instants inside a tick whose mean is rendered where the motion within one tick is more than
            `max_px`; 1 is off.
    """

    n_ticks: int
    rate_hz: int
    max_px: float
    chain: tuple[int, ...]
    sub_ticks: int = 1

    @property
    def ticks(self) -> list[int]:
        """Return all ticks with a key, ascending from 0 to the first coarse key at or after `n_ticks`."""
        return list(range(0, -(-self.n_ticks // self.chain[0]) * self.chain[0] + 1, self.chain[-1]))

    def level(self, tick: int) -> int:
        """Return the index in `chain` of a tick's key: the coarsest spacing that divides the tick. 0 is a whole key."""
        return next(level for level, spacing in enumerate(self.chain) if tick % spacing == 0)


def key_plan(
    world: WorldScene,
    cameras: Sequence[Camera],
    n_ticks: int,
    rate_hz: int,
    max_px: float,
    *,
    adaptive: bool = True,
    sub_ticks: bool = True,
    path: ArrayPath | None = None,
) -> KeyPlan:
    """Return the plan for a clip, from the exact image motion of the world's geometry.

    Raises UserError where a millisecond is no whole number of ticks.

    Args:
        world: the world with its moving objects.
        cameras: the views.
        n_ticks: length of the clip.
        rate_hz: ticks per second, a multiple of 1000.
        max_px: largest motion of an image point between two of its keys.
        adaptive: False renders every changing pixel at every tick: slow and exact.
        sub_ticks: False never renders instants inside a tick.
        path: the motion of the array; None: it stands still.
    """
    speed = max_image_speed(world, cameras, n_ticks / rate_hz, path=path)
    chain = spacings(speed, n_ticks, rate_hz, max_px) if adaptive else (1,)
    instants = 1
    while chain[-1] == 1 and sub_ticks and instants < min(speed / rate_hz / max_px, _MOST_SUB_TICKS):
        instants *= 2
    return KeyPlan(n_ticks, rate_hz, max_px, chain, instants)


def spacings(speed_px_s: float, n_ticks: int, rate_hz: int, max_px: float) -> tuple[int, ...]:
    """Return the key spacings in ticks, coarsest first, for a clip whose fastest point has this speed.

    All divide a millisecond, so that a frame at every whole millisecond is exactly a key. The finest is the longest in
    which no point of this speed moves by more than `max_px` (one tick, if even that is too long). Each other is the
    shortest multiple of the one after it, as long as that point moves by no more than 2.5 px.
    Raises UserError where a millisecond is no whole number of ticks.
    """
    per_ms, rest = divmod(rate_hz, 1000)
    if rest or per_ms < 1 or n_ticks < 1 or max_px <= 0:
        found = f"rate {rate_hz} Hz, {n_ticks} ticks, {max_px} px"
        raise problem(
            "key frames", "a multiple of 1000 Hz, at least 1 tick, a positive motion", found, "change the profile"
        )

    divisors = [d for d in range(1, per_ms + 1) if per_ms % d == 0]
    chain = [max((d for d in divisors if speed_px_s * d / rate_hz <= max_px), default=1)]
    while coarser := [
        d for d in divisors if d > chain[0] and d % chain[0] == 0 and speed_px_s * d / rate_hz <= COARSE_PX
    ]:
        chain.insert(0, coarser[0])
    return tuple(chain)
