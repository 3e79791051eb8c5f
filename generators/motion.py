"""How fast things move across the picture, and how far apart key frames may lie."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spike4dgs.benchmark.cameras import Camera
from spike4dgs.benchmark.errors import problem
from spike4dgs.generators.worlds import WorldScene

_STEP_S = 1e-6  # short against every motion here, long against float64 round-off of metres


def max_image_speed(world: WorldScene, cameras: Sequence[Camera], duration_s: float, samples: int = 33) -> float:
    """Speed in px/s of the fastest visible image point over all views and `samples` times of the clip.

    Exact from geometry: every vertex of the moving meshes is projected at t and a microsecond later, rotation
    included. Occlusion is not considered, so the answer is an upper bound that is met wherever that vertex is seen.
    """
    fastest = 0.0
    for t in np.linspace(0.0, duration_s, samples):
        before, after = world.moving_points(t), world.moving_points(t + _STEP_S)
        for camera in cameras:
            uv, z = camera.project(before)
            uv_after, _ = camera.project(after)
            seen = (z > 0) & (uv > 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
            speed = np.linalg.norm(uv_after - uv, axis=1)[seen] / _STEP_S
            fastest = max(fastest, float(speed.max(initial=0.0)))
    return fastest


def key_ticks(speed_px_s: float, n_ticks: int, rate_hz: int, max_px: float = 0.5) -> np.ndarray:
    """Ticks at which key frames are rendered: ascending int64, from 0 to the first one at or after `n_ticks`.

    The spacing is the largest divisor of a millisecond (in ticks) at which the fastest point moves at most `max_px`
    per key, or one tick where even that is too long; so a frame at every whole millisecond is exactly a key.
    The last key covers the whole of the last tick, so that interpolation never extrapolates.
    Raises UserError where a millisecond is no whole number of ticks.
    """
    per_ms, rest = divmod(rate_hz, 1000)
    if rest or per_ms < 1 or n_ticks < 1 or max_px <= 0:
        found = f"rate {rate_hz} Hz, {n_ticks} ticks, {max_px} px"
        raise problem(
            "key frames", "a multiple of 1000 Hz, at least 1 tick, a positive motion", found, "change the profile"
        )
    divisors = [d for d in range(1, per_ms + 1) if per_ms % d == 0]
    fitting = [d for d in divisors if speed_px_s * d / rate_hz <= max_px]
    spacing = max(fitting, default=1)
    return np.arange(0, -(-n_ticks // spacing) * spacing + 1, spacing, dtype=np.int64)
