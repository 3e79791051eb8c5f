"""An event camera before the same scene: an event whenever a pixel's log radiance has changed by the threshold.

Contrast-threshold model without noise (as in ESIM, Rebecq et al. 2018): each pixel remembers the log radiance of its
last event, at first that of the first key, and fires one event, positive or negative, each time it is a whole threshold
away. Between keys log radiance is linear in time; times are microseconds, rounded down.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.spikes.bits import kernel
from spike4dgs.generators.sensor.model import Float32

THRESHOLD = 0.2  # of log radiance
_DARKEST = 1e-3  # radiance below which log radiance does not fall


class Events(NamedTuple):
    """Events in order of time, then row, then column."""

    t: NDArray[np.int64]  # microseconds from the start of the clip
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.uint8]  # 1: brighter, 0: darker


def events(
    keys: Sequence[Float32], key_ticks: Sequence[int], n_ticks: int, rate_hz: int, threshold: float = THRESHOLD
) -> Events:
    """Events of a clip from radiance keys [H, W], which are read one at a time; those after `n_ticks` are left out."""
    before = _log(keys[0])
    level = before.astype(np.float64)
    height, width = before.shape
    found = []
    for k in range(1, len(key_ticks)):
        if key_ticks[k - 1] >= n_ticks:
            break
        after = _log(keys[k])
        span_us = np.array([key_ticks[k - 1], key_ticks[k]]) * 1e6 / rate_hz
        room = int(np.ceil(np.abs(after - level) / threshold).sum()) + 1
        t, pixel, p = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.uint8)
        n = crossings(before.ravel(), after.ravel(), level.ravel(), span_us[0], span_us[1], threshold, t, pixel, p)
        order = np.lexsort((pixel[:n], t[:n]))
        found.append((t[:n][order], pixel[:n][order], p[:n][order]))
        before = after
    t, pixel, p = (np.concatenate([f[i] for f in found]) for i in range(3))
    inside = t < n_ticks * 1e6 / rate_hz
    y, x = np.divmod(pixel[inside], width)
    return Events(t[inside], x.astype(np.uint16), y.astype(np.uint16), p[inside])


def _log(image: Float32) -> NDArray[np.float64]:
    return np.log(np.maximum(np.asarray(image, dtype=np.float64), _DARKEST))


@kernel
def crossings(
    before: Any, after: Any, level: Any, start_us: Any, end_us: Any, threshold: Any, t: Any, pixel: Any, p: Any
) -> int:
    """Fill t, pixel and p with the events of one interval, pixel by pixel; advance `level`; return their number.

    before, after, level: log radiance [P] at the start, at the end, and of the last event.
    """
    n = 0
    for i in range(len(before)):
        a, b = before[i], after[i]
        if a == b:
            continue
        sign = 1.0 if b > a else -1.0
        step = sign * threshold
        while (b - level[i] - step) * sign >= 0.0:
            level[i] += step
            share = (level[i] - a) / (b - a)
            share = min(max(share, 0.0), 1.0)  # round-off at the ends
            t[n] = np.int64(start_us + share * (end_us - start_us))
            pixel[n] = i
            p[n] = 1 if sign > 0 else 0
            n += 1
    return n


def write_events(path: Path, found: Events) -> None:
    """Write events as `.npz` with the arrays t, x, y, p. Equal events give equal bytes."""
    with atomic_path(path) as part:
        np.savez_compressed(part, allow_pickle=False, **found._asdict())


def read_events(path: Path) -> Events:
    """Read events. Raises UserError where the file is missing or damaged."""
    try:
        with open(path, "rb") as f, np.load(f) as data:
            return Events(*(data[name] for name in Events._fields))
    except FileNotFoundError:
        raise problem(path, "events", "no such file", "restore it or make the scene again") from None
    except (zipfile.BadZipFile, KeyError, ValueError, OSError, EOFError) as e:
        raise problem(
            path, "events (t, x, y, p)", f"damaged data ({e})", "restore it or make the scene again"
        ) from None
