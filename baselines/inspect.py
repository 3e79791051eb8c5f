"""`inspect`: statistics of a stream or a scene. Rates, bad pixels, inter-spike intervals, and images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tyro.conf import Positional

from spike4dgs.baselines.spike_to_image.table import IMAGES
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.spikes.folder import NAME as STREAM_FOLDER
from spike4dgs.benchmark.spikes.folder import open_stream_folder
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.stream import SpikeStream, open_stream

Mask = NDArray[np.bool_]
HOT_SIGMA = 6.0  # robust standard deviations above the neighbours' median, from which a pixel is called hot
_INTERVAL_TICKS = 2000  # ticks at the clip's start that inter-spike intervals are taken from
_LONGEST_WINDOW = 60000  # ticks per count image: counts are 16 bits wide
_TIMELINE_BINS = 400


@dataclass(frozen=True, eq=False)
class StreamReport:
    """Statistics of one stream. `rate` is spikes per tick [H, W] over the ticks that a recording does not lack."""

    name: str
    rate: NDArray[np.float64]
    dead: Mask  # [H, W] never fires although its neighbours do
    hot: Mask  # [H, W] fires far more than its neighbours
    two_intervals: float  # share of pixels whose inter-spike intervals take at most two adjacent values
    rate_hz: float
    n_ticks: int
    missing: int  # ticks within gaps


def examine(name: str, stream: SpikeStream) -> StreamReport:
    """Return the statistics of a whole stream, and its bad pixels.

    A pixel is dead where it never fires while the median of its 5x5 neighbourhood would fire at least ten times. It is
    hot where its rate is more than HOT_SIGMA robust standard deviations of (rate - neighbourhood median), and at least
    half of that median, above it. Ticks within gaps count nowhere.
    """
    from scipy.ndimage import median_filter

    counts = np.zeros((stream.height, stream.width), np.int64)
    for start in range(0, stream.n_ticks, _LONGEST_WINDOW):
        counts += stream.counts(start, min(start + _LONGEST_WINDOW, stream.n_ticks))
    seen = max(int(present(stream.gaps, stream.n_ticks).sum()), 1)
    rate = counts / seen
    around = median_filter(rate, size=5, mode="nearest")
    excess = rate - around
    sigma = 1.4826 * float(np.median(np.abs(excess - np.median(excess))))
    dead = (counts == 0) & (around * seen >= 10)
    hot = (excess > HOT_SIGMA * max(sigma, 1 / seen)) & (excess > 0.5 * around)
    missing = sum(gap.ticks for gap in stream.gaps)
    return StreamReport(name, rate, dead, hot, _two_intervals(stream), stream.rate_hz, stream.n_ticks, missing)


def _two_intervals(stream: SpikeStream) -> float:
    """Return the share of the pixels with at least three spikes whose intervals are all k or k + 1.

    Steady light on a pixel that keeps the charge above the threshold gives exactly that: a test of the sensor model.
    """
    shape = stream.height, stream.width
    last, intervals, seen = np.full(shape, -1), np.zeros(shape, np.int64), present(stream.gaps, stream.n_ticks)
    shortest, longest = np.full(shape, np.iinfo(np.int64).max), np.zeros(shape, np.int64)
    for start in range(0, min(stream.n_ticks, _INTERVAL_TICKS), 100):
        for t, fired in enumerate(stream.window(start, min(start + 100, stream.n_ticks)), start):
            if not seen[t]:  # an interval across a gap would be too long
                last[:] = -1
                continue
            again = (fired != 0) & (last >= 0)
            length = t - last[again]
            shortest[again] = np.minimum(shortest[again], length)
            longest[again] = np.maximum(longest[again], length)
            last[fired != 0] = t
            intervals += again
    enough = intervals >= 2
    return float(np.mean(longest[enough] - shortest[enough] <= 1)) if enough.any() else float("nan")


def write_image(path: Path, report: StreamReport, stream: SpikeStream) -> None:
    """Write one PNG: TFP and TFI of the middle of the clip, the map of bad pixels, and the histogram of rates.

    Where a recording has gaps, a plot of the rate over time marks them, and the images are of the middle of the longest
    stretch without one.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    middle = _middle(stream)
    gain = float(np.percentile(report.rate, 99)) or 1.0  # shown as white; the scale of a raw recording is unknown
    aspect = stream.height / stream.width
    heights = [6 * aspect + 0.6] * 2 + [2.4] * bool(stream.gaps)  # inches
    mosaic: list[Any] = [["tfp", "tfi"], ["bad", "rates"], ["time", "time"]][: len(heights)]
    figure, axes = plt.subplot_mosaic(mosaic, figsize=(12, sum(heights)), height_ratios=heights, layout="constrained")
    for name in ("tfp", "tfi"):
        axes[name].imshow(encode_srgb(IMAGES[name](stream, [middle], gain)[0]), cmap="gray", vmin=0, vmax=255)
        axes[name].set_title(f"{name.upper()} at tick {middle}")
    _show_bad_pixels(axes["bad"], report)
    axes["rates"].hist(report.rate.ravel(), bins=100, color="0.3")
    axes["rates"].set(xlabel="spikes per tick", ylabel="pixels", title=f"Rates, mean {report.rate.mean():.4f}")
    if stream.gaps:
        _plot_gaps(axes["time"], stream)
    for name in ("tfp", "tfi", "bad"):
        axes[name].set_xticks([])
        axes[name].set_yticks([])
    figure.suptitle(f"{report.name}: {stream.n_ticks} ticks of {stream.width}x{stream.height} at {stream.rate_hz:g} Hz")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _middle(stream: SpikeStream) -> int:
    """Return the tick in the middle of the longest stretch of the clip that has data."""
    edges = [-1, *(np.nonzero(~present(stream.gaps, stream.n_ticks))[0]), stream.n_ticks]
    longest = int(np.argmax(np.diff(edges)))
    return min(int(edges[longest] + 1 + edges[longest + 1]) // 2, stream.n_ticks - 1)


def _plot_gaps(axis: Any, stream: SpikeStream) -> None:
    """Plot the rate over the clip, interrupted and marked with the reason where ticks are missing."""
    bins = np.linspace(0, stream.n_ticks, min(stream.n_ticks, _TIMELINE_BINS) + 1).astype(int)
    spikes = [int(np.bitwise_count(stream.packed[a:b]).sum()) for a, b in zip(bins[:-1], bins[1:], strict=True)]
    seen = np.add.reduceat(present(stream.gaps, stream.n_ticks).astype(int), bins[:-1])
    with np.errstate(invalid="ignore"):  # bins without data are NaN, which leaves a hole
        axis.stairs(np.array(spikes) / seen / (stream.width * stream.height), bins, color="0.3", baseline=None)
    for i, reason in enumerate(sorted({gap.reason for gap in stream.gaps}), start=1):
        spans = [(gap.first_tick, gap.ticks) for gap in stream.gaps if gap.reason == reason]
        label = f"{reason}: {len(spans)} gap(s), {sum(ticks for _, ticks in spans)} ticks"
        for first, ticks in spans:  # the edge keeps a single tick visible
            axis.axvspan(first, first + ticks, color=f"C{i}", alpha=0.4, linewidth=1, label=label)
            label = "_"
    axis.set(xlabel="tick", ylabel="spikes per tick", xlim=(0, stream.n_ticks), title="Mean rate; marked: no data")
    axis.legend(loc="upper right")


def _show_bad_pixels(axis: Any, report: StreamReport) -> None:
    axis.imshow(report.rate, cmap="gray")
    for mask, color, what in ((report.dead, "tab:blue", "dead"), (report.hot, "tab:red", "hot")):
        y, x = np.nonzero(mask)
        axis.scatter(x, y, s=12, facecolors="none", edgecolors=color, label=f"{len(x)} {what}")
    axis.legend(loc="lower right")
    axis.set_title("Mean rate, bad pixels circled")


def _print_reports(reports: list[StreamReport]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("stream", "ticks", "missing", "mean", "median", "p1", "p99", "spikes/s", "dead", "hot", "two ISIs")
    for r in reports:
        p1, p50, p99 = (f"{v:.4f}" for v in np.percentile(r.rate, (1, 50, 99)))
        per_second = f"{r.rate.mean() * r.rate_hz:.0f}"
        bad = f"{r.dead.sum()}", f"{r.hot.sum()}"
        table.add_row(
            r.name,
            f"{r.n_ticks}",
            f"{r.missing}",
            f"{r.rate.mean():.4f}",
            p50,
            p1,
            p99,
            per_second,
            *bad,
            f"{r.two_intervals:.1%}",
        )
    console = Console()
    console.print(table)
    print("Rates are spikes per tick and pixel; 'two ISIs' is the share of pixels with only two adjacent intervals.")
    for r in reports:
        for what, mask in (("dead", r.dead), ("hot", r.hot)):
            if mask.any():
                first = ", ".join(f"({x}, {y})" for y, x in np.argwhere(mask)[:5])
                print(f"{r.name}: {mask.sum()} {what} pixels, the first (x, y): {first}")


def _open(
    path: Path, width: int | None, height: int | None, fps: float | None, top_down: bool, allow_gaps: bool
) -> dict[str, SpikeStream]:
    size = {"--width": width, "--height": height, "--fps": fps}
    if path.is_dir():
        if given := [name for name, value in size.items() if value is not None]:
            raise problem(
                ", ".join(given), "nothing for a folder, which states its own size", "values", "leave them out"
            )
        if (path / STREAM_FOLDER).is_file():
            return open_stream_folder(path, allow_gaps)
        scene = open_scene(path, allow_gaps)
        return {camera: scene.stream(camera) for camera in scene.cameras}
    if not path.exists():
        raise problem(path, "a stream file or a scene folder", "no such file", "check the path")
    if width is None or height is None or fps is None:
        missing = ", ".join(name for name, value in size.items() if value is None)
        raise problem(
            path, "--width, --height and --fps for a headerless stream", f"no {missing}", "state the camera's"
        )
    if fps <= 0:
        raise problem("--fps", "a positive rate", f"{fps:g}", "state the camera's")
    return {path.stem: open_stream(path, width, height, fps, rows_bottom_up=not top_down)}


def inspect(
    path: Positional[Path],
    *,
    width: int | None = None,
    height: int | None = None,
    fps: float | None = None,
    top_down: bool = False,
    out: Path = Path("runs/inspect"),
    allow_gaps: bool = False,
) -> int:
    """Show a scene's streams, or one raw stream: rates, dead and hot pixels, interval statistics, TFP and TFI images.

    Args:
        path: A scene folder, a folder of imported streams, or a headerless .dat file.
        width: Pixels per row of a .dat file.
        height: Rows of a .dat file.
        fps: Ticks per second of a .dat file.
        top_down: The first row of a .dat file is the top one (cameras of this kind store the bottom row first).
        out: Folder for the images, one PNG per stream.
        allow_gaps: Accept recordings with gaps.
    """
    reports = []
    streams = _open(path, width, height, fps, top_down, allow_gaps)
    for name, stream in streams.items():
        report = examine(name, stream)
        write_image(out / f"{path.resolve().name if path.is_dir() else path.stem}" / f"{name}.png", report, stream)
        reports.append(report)
    _print_reports(reports)
    for gap in (gap for stream in streams.values() for gap in stream.gaps):
        print(f"{gap.camera}: no data in ticks [{gap.first_tick}, {gap.stop_tick}): {gap.ticks} ticks, {gap.reason}")
    print(f"images: {out / (path.resolve().name if path.is_dir() else path.stem)}")
    return 0
