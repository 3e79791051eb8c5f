"""`inspect`: statistics of a stream or a scene. Rates, bad pixels, inter-spike intervals, and images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape
from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark.exchange.streams import DAT_FILE, DatFile, open_streams
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.benchmark.scene.calibration import Recordings
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.benchmark.spikes.bad_pixels import BadPixels, find_bad
from spike4dgs.benchmark.spikes.counted_recording import mean_rate
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.cli.options import warn_of_size, white_of
from spike4dgs.studies.kit.timing import write_csv

_INTERVAL_TICKS = 2000  # ticks at the clip's start that inter-spike intervals are taken from
_TIMELINE_BINS = 400
# Of the table of statistics, and how the console shows them.
_COLUMNS = {
    "stream": "",
    "ticks": "",
    "missing": "",
    "mean": ".4f",
    "median": ".4f",
    "p1": ".4f",
    "p99": ".4f",
    "spikes/s": ".0f",
    "dead": "",
    "hot": "",
    "flickering": "",
    "bad from": "",
    "two ISIs": ".1%",
}


@dataclass(frozen=True, eq=False)
class StreamReport:
    """Statistics of one stream. `rate` is spikes per tick [H, W] over the ticks that a recording does not lack."""

    name: str
    rate: NDArray[np.float64]
    bad: BadPixels
    two_intervals: float  # share of pixels whose inter-spike intervals take at most two adjacent values
    rate_hz: float
    n_ticks: int
    missing: int  # ticks within gaps


_WIDEST = 4.0  # sides of a panel: titles and legends need room next to a scene of one row


def examine(name: str, stream: SpikeStream, recordings: Recordings | None = None) -> StreamReport:
    """Return the statistics of a whole stream, and its bad pixels: from recordings, or by isolation without any.

    Ticks within gaps count nowhere.
    """
    rate = mean_rate(stream)
    bad = find_bad(stream, recordings.flat, recordings.dark) if recordings else find_bad(stream)
    missing = sum(gap.ticks for gap in stream.gaps)
    return StreamReport(name, rate, bad, _two_intervals(stream), stream.rate_hz, stream.n_ticks, missing)


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
    middle = _middle(stream)
    gain = white_of([report.rate], [stream])  # the scale of a raw recording is unknown
    aspect = min(max(stream.height / stream.width, 1 / _WIDEST), _WIDEST)  # of the panel; the image keeps its shape
    heights = [6 * aspect + 0.6] * 2 + [2.4] * bool(stream.gaps)  # inches
    mosaic: list[Any] = [["tfp", "tfi"], ["bad", "rates"], ["time", "time"]][: len(heights)]
    figure = new_figure((12, sum(heights)), dpi=100)
    axes: Any = figure.subplot_mosaic(mosaic, height_ratios=heights)
    for name in ("tfp", "tfi"):
        axes[name].imshow(encode_srgb(IMAGES[name](stream, [middle], gain)[0]), cmap="gray", vmin=0, vmax=255)
        axes[name].set_title(f"{name.upper()} at tick {middle}")
    _show_bad_pixels(axes["bad"], report)
    axes["rates"].hist(report.rate.ravel(), bins=_between_counts(report), color="0.3")
    axes["rates"].set(xlabel="spikes per tick", ylabel="pixels", title=f"Rates, mean {report.rate.mean():.4f}")
    if stream.gaps:
        _plot_gaps(axes["time"], stream)
    for name in ("tfp", "tfi", "bad"):
        axes[name].set(xticks=[], yticks=[])
    figure.suptitle(f"{report.name}: {stream.n_ticks} ticks of {stream.width}x{stream.height} at {stream.rate_hz:g} Hz")
    save_figure(figure, path)


def _between_counts(report: StreamReport) -> NDArray[np.float64]:
    """Return the edges of at most about 100 bins that hold equally many counts each: rates are whole spikes a clip."""
    ticks = max(report.n_ticks - report.missing, 1)
    most = round(float(report.rate.max()) * ticks)
    step = -(-(most + 1) // 100)
    return (np.arange(0, most + 1 + step, step) - 0.5) / ticks


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
    for color, (what, mask) in zip(("tab:blue", "tab:red", "tab:orange"), report.bad.kinds.items(), strict=True):
        y, x = np.nonzero(mask)
        axis.scatter(x, y, s=12, facecolors="none", edgecolors=color, label=f"{len(x)} {what}")
    axis.legend(loc="lower right")
    axis.set_title(f"Mean rate, bad pixels circled (from {report.bad.source})")


def _row(r: StreamReport) -> dict[str, Any]:
    """Return the values of a line of the table, in the order of _COLUMNS."""
    low, middle, high = np.percentile(r.rate, (1, 50, 99))
    rates = r.rate.mean(), middle, low, high, r.rate.mean() * r.rate_hz
    bad = *(int(mask.sum()) for mask in r.bad.kinds.values()), r.bad.source
    return dict(zip(_COLUMNS, (r.name, r.n_ticks, r.missing, *rates, *bad, r.two_intervals), strict=True))


def _print_reports(reports: list[StreamReport]) -> None:
    table = Table(*_COLUMNS)
    for row in map(_row, reports):
        table.add_row(*(escape(format(value, _COLUMNS[name])) for name, value in row.items()))
    make_console().print(table)
    print("Rates are spikes per tick and pixel; 'two ISIs' is the share of pixels with only two adjacent intervals.")
    for r in reports:
        if not r.rate.any():
            print(f"{r.name}: no spike in the whole clip")
        for what, mask in r.bad.kinds.items():
            if mask.any():
                first = ", ".join(f"({x}, {y})" for y, x in np.argwhere(mask)[:5])
                print(f"{r.name}: {mask.sum()} {what} pixels, the first (x, y): {first}")


def inspect(
    path: Positional[Path],
    *,
    dat_file: OmitArgPrefixes[DatFile] = DAT_FILE,
    out: Path = Path("runs/inspect"),
    allow_gaps: bool = False,
) -> int:
    """Show a scene's streams, or one raw stream: rates, bad pixels, interval statistics, TFP and TFI images.

    Dead, hot and flickering pixels are found in the scene's recordings of uniform light and of darkness. Without these,
    pixels that differ from all of their neighbours count as bad. The table is printed, and written to statistics.csv.

    Args:
        path: A scene folder, a folder of imported streams, or a headerless .dat file.
        out: Folder for the results: one PNG per stream and statistics.csv, in a subfolder named after PATH.
        allow_gaps: Accept recordings with gaps.
    """
    opened = open_streams(path, dat_file, allow_gaps)
    scene = opened if isinstance(opened, Scene) else None
    # A training part has the poses of cameras whose streams it lacks.
    streams = {c: opened.stream(c) for c in opened.meta["streams"]} if isinstance(opened, Scene) else opened
    if not path.is_dir():
        warn_of_size(streams)
    folder = out / (path.resolve().name if path.is_dir() else path.stem)
    reports = []
    for name, stream in streams.items():
        reports.append(examine(name, stream, scene.recordings(name) if scene else None))
        write_image(folder / f"{name}.png", reports[-1], stream)
    _print_reports(reports)
    write_csv(folder / "statistics.csv", [*_COLUMNS], [[*_row(r).values()] for r in reports])
    for gap in (gap for stream in streams.values() for gap in stream.gaps):
        print(f"{gap.camera}: no data in ticks [{gap.first_tick}, {gap.stop_tick}): {gap.ticks} ticks, {gap.reason}")
    print(f"images and statistics.csv: {folder}")
    return 0
