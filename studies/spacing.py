"""`spacing`: the error of interpolated radiance and of spikes against render time, for several key-frame spacings.

One view of a world is rendered at every tick: the truth. Then only every 2nd, 4th, 8th ... of these frames is kept, and
the ticks between are interpolated, linearly and by the simulator's clamped Catmull-Rom curve. Errors are taken in
windows of 32 ticks, at pixels whose radiance varies by more than 1 % in the window.
"""

from __future__ import annotations

import csv
import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tyro.conf import Positional

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.generators.profiles import RATE_HZ
from spike4dgs.generators.sensor.model import Sensor, random_charge
from spike4dgs.generators.sensor.reference import fire, tick_means

WINDOW = 32  # ticks
_FLOOR = 0.02  # relative errors are in units of the true radiance, or of this where it is darker
_VARIES = 0.01
_PHASE = "another initial phase"


@dataclass(frozen=True)
class Row:
    """One spacing and one interpolation. Errors are percentages of the true radiance; counts are spikes per window."""

    interpolation: str
    motion_px: float  # of the fastest image point between two keys
    spacing_ticks: int
    keys_per_ms: float
    render_s_per_ms: float  # wall time for one view and one millisecond of the clip
    integral_error_mean: float  # of the radiance summed over a window
    tick_error_mean: float
    tick_error_p999: float
    counts_off: float  # share of windows whose spike count is off by one or more


def spacing(
    world: Positional[str] = "car",
    *,
    out: Path = Path("runs/spacing"),
    width: int = 200,
    height: int = 125,
    ticks: int = 256,
    spp: int = 64,
    seed: int = 0,
    variant: int = 0,
) -> int:
    """Report key-frame spacing against errors and render time: OUT/WORLD.csv and OUT/WORLD.png.

    Args:
        world: Name of a world.
        out: Folder for the table and the plot.
        width: Width of the image in pixels.
        height: Height of the image in pixels.
        ticks: Length of the clip, a multiple of 64 ticks; every tick is rendered once.
        spp: Samples per pixel, a power of two.
        seed: Seed of the world and the rendering.
        variant: Variant of the world.
    """
    from rich.console import Console

    from spike4dgs.generators.worlds import WORLDS

    if world not in WORLDS:
        raise problem("world", f"one of {', '.join(WORLDS)}", repr(world), "correct the name")
    if ticks < 64 or ticks % 64:
        raise problem("--ticks", "a positive multiple of 64", str(ticks), "give 256, for example")
    console = Console(highlight=False, width=120)
    built = WORLDS[world].build(seed, variant, ticks / RATE_HZ)
    frames, speed_px_s, seconds = render_every_tick(built, (width, height), ticks, spp, seed, console)
    rows = compare(frames, speed_px_s, seconds, [2**k for k in range(1, 7)], seed)
    out.mkdir(parents=True, exist_ok=True)
    with atomic_path(out / f"{world}.csv") as part, open(part, "w", newline="") as f:
        writer = csv.DictWriter(f, [x.name for x in fields(Row)])
        writer.writeheader()
        writer.writerows({k: v if isinstance(v, str) else f"{v:.6g}" for k, v in asdict(r).items()} for r in rows)
    _plot(rows, out / f"{world}.png", f"{world}, {width}x{height}, {spp} spp, {ticks} ticks")
    _show(rows, console)
    console.print(f"table and plot: {out / world}.csv, .png", markup=False)
    return 0


def compare(
    frames: Float32, speed_px_s: float, seconds_per_key: float, spacings: Sequence[int], seed: int = 0
) -> list[Row]:
    """Return a row for each spacing and interpolation, from frames [n + 1, H, W] at every tick's start.

    The last row is a yardstick: the change of counts with another random initial phase, and exact radiance.
    """
    n = len(frames) - 1
    truth = np.stack(list(tick_means(frames, range(n + 1), n)))
    moving = _moving(frames)
    charge = random_charge(frames.shape[1], frames.shape[2], [seed, 0])
    counts = _counts(truth, charge)
    rows = []
    for step, curve in itertools.product(spacings, (tick_means, linear_means)):
        keys = range(0, n + 1, step)
        means = np.stack(list(curve(frames[::step], keys, n)))
        name = "linear" if curve is linear_means else "Catmull-Rom"
        errors = _errors(means, truth, moving)
        off = _share_off(_counts(means, charge), counts, moving)
        per_ms = RATE_HZ / 1000 / step
        rows.append(Row(name, speed_px_s * step / RATE_HZ, step, per_ms, per_ms * seconds_per_key, *errors, off))
    other = _counts(truth, random_charge(frames.shape[1], frames.shape[2], [seed, 1]))
    rows.append(Row(_PHASE, 0.0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, _share_off(other, counts, moving)))
    return rows


def linear_means(keys: Float32, key_ticks: Sequence[int], n_ticks: int) -> Iterator[Float64]:
    """Yield the mean radiance [H, W] of each tick on straight lines between the keys."""
    for k, (start, end) in enumerate(itertools.pairwise(key_ticks)):
        for tick in range(start, min(end, n_ticks)):
            u = (tick + 0.5 - start) / (end - start)
            yield np.asarray((1 - u) * keys[k].astype(np.float64) + u * keys[k + 1])


def _windows(values: NDArray[Any]) -> NDArray[Any]:
    """Split values [n, H, W] into windows [n / 32, 32, H, W]."""
    return values.reshape(-1, WINDOW, *values.shape[1:])


def _moving(frames: Float32) -> NDArray[np.bool_]:
    """Return [n / 32, H, W]: pixels whose radiance varies in the window."""
    parts = _windows(frames[:-1])
    low, high = parts.min(1), parts.max(1)
    return np.asarray(high - low > _VARIES * np.maximum(high, _FLOOR))


def _errors(means: Float64, truth: Float64, moving: NDArray[np.bool_]) -> tuple[float, float, float]:
    """Return in percent: mean error of the window integral, mean and 99.9th percentile of the tick's radiance."""
    a, b = _windows(means), _windows(truth)
    integral = np.abs(a.sum(1) - b.sum(1)) / np.maximum(b.sum(1), _FLOOR * WINDOW)
    tick = (np.abs(a - b) / np.maximum(b, _FLOOR)).transpose(0, 2, 3, 1)[moving]
    return 100 * integral[moving].mean(), 100 * tick.mean(), 100 * float(np.percentile(tick, 99.9))


def _counts(means: Float64, charge: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the spikes per window [n / 32, H, W]."""
    spikes = np.stack([fired for fired, _ in fire(iter(means), Sensor(), charge)])
    return np.asarray(_windows(spikes).sum(1))


def _share_off(a: NDArray[np.int64], b: NDArray[np.int64], moving: NDArray[np.bool_]) -> float:
    return 100 * float((a != b)[moving].mean())


def render_every_tick(
    world: Any, size: tuple[int, int], n: int, spp: int, seed: int, console: Any
) -> tuple[Float32, float, float]:
    """Return the frames [n + 1, H, W] at every tick, speed of the fastest point in px/s, seconds per frame."""
    from rich.progress import Progress

    from spike4dgs.generators.profiles import HELD_OUT_VIEW
    from spike4dgs.generators.rendering.image_motion import max_image_speed
    from spike4dgs.generators.rendering.render import MultiViewRenderer
    from spike4dgs.generators.rig import cameras

    views = cameras(world, *size, [HELD_OUT_VIEW])
    renderer = MultiViewRenderer(world, views, seed=seed, spp=spp, background_spp=4 * spp)
    renderer.keys(0.0)  # background and compilation of kernels are not part of a key's time
    start = time.perf_counter()
    with Progress(console=console, disable=not console.is_terminal) as bars:
        ticks = bars.track(range(n + 1), description="every tick")
        frames = np.stack([renderer.keys(t / RATE_HZ)[0] for t in ticks])
    return frames, max_image_speed(world, views, n / RATE_HZ), (time.perf_counter() - start) / (n + 1)


def _plot(rows: Sequence[Row], path: Path, title: str) -> None:
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = Figure(figsize=(15, 5.2), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    for name, style in (("Catmull-Rom", "o-"), ("linear", "s--")):
        part = [r for r in rows if r.interpolation == name]
        px = [r.motion_px for r in part]
        for values, label, colour in (
            ([r.tick_error_mean for r in part], "tick, mean", "C0"),
            ([r.tick_error_p999 for r in part], "tick, 99.9th percentile", "C1"),
            ([r.integral_error_mean for r in part], f"integral over {WINDOW} ticks, mean", "C2"),
        ):
            left.plot(px, values, style, color=colour, label=f"{label} ({name})", markersize=4)
        middle.plot(px, [r.counts_off for r in part], style, color="C3", label=name, markersize=4)
        right.plot(
            [r.render_s_per_ms for r in part], [r.counts_off for r in part], style, color="C3", label=name, markersize=4
        )
    for r in (r for r in rows if r.interpolation == "Catmull-Rom"):
        right.annotate(
            f"{r.motion_px:.2g} px",
            (r.render_s_per_ms, r.counts_off),
            (-8, -14),
            textcoords="offset points",
            fontsize=8,
        )
    for r in (r for r in rows if r.interpolation == _PHASE):
        middle.axhline(r.counts_off, color="0.5", linestyle=":", label=_PHASE)
    left.set(ylabel="error of the radiance (% of the true one)", title="radiance at moving pixels")
    middle.set(
        ylabel=f"counts off by one or more (% of {WINDOW}-tick windows)", title="spike counts, same initial phase"
    )
    right.set(xlabel="render time (s per ms of clip and view)", ylabel="counts off (%)", title="what it costs")
    for axes in (left, middle):
        axes.axvline(0.5, color="0.8", zorder=0)
        axes.set(xlabel="motion of the fastest point between keys (px)")
    for axes in (left, middle, right):
        axes.set(xscale="log", yscale="log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
        axes.grid(True, color="0.9")
    right.margins(0.12)
    low, high = left.get_ylim()
    left.set_ylim(low, high * 15)  # room for the legend
    for axes in (left, middle, right):
        axes.legend(fontsize=8, loc="upper right" if axes is right else "upper left")
    figure.suptitle(title)
    with atomic_path(path) as part_path:
        figure.savefig(part_path)


def _show(rows: Sequence[Row], console: Any) -> None:
    from rich.table import Table

    table = Table(box=None, title="errors in % at moving pixels")
    for f in fields(Row):
        text = f.name == "interpolation"
        table.add_column(f.name.replace("_", " "), justify="left" if text else "right", no_wrap=text)
    for r in rows:
        table.add_row(*(v if isinstance(v, str) else f"{v:.3g}" for v in asdict(r).values()))
    console.print(table)
