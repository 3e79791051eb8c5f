"""`inspect`: what is in a stream or a scene? Rates, bad pixels, interval statistics, and pictures to look at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tyro.conf import Positional

from spike4dgs.baselines.spike_to_image import IMAGES
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.images import encode_srgb
from spike4dgs.benchmark.scene import open_scene
from spike4dgs.benchmark.spikes import SpikeStream, open_stream
from spike4dgs.benchmark.stream_folder import NAME as STREAM_FOLDER
from spike4dgs.benchmark.stream_folder import open_stream_folder

Mask = NDArray[np.bool_]
HOT_SIGMA = 6.0  # robust standard deviations above the neighbours' median, from which a pixel is called hot
_INTERVAL_TICKS = 2000  # inter-spike intervals are looked at in at most so many ticks
_LONGEST_WINDOW = 60000  # ticks per count image


@dataclass(frozen=True, eq=False)
class StreamReport:
    """Statistics of one stream. `rate` is spikes per tick [H, W]."""

    name: str
    rate: NDArray[np.float64]
    dead: Mask  # [H, W] never fires although its neighbours do
    hot: Mask  # [H, W] fires far more than its neighbours
    two_intervals: float  # share of pixels whose inter-spike intervals take at most two adjacent values
    rate_hz: float
    n_ticks: int


def examine(name: str, stream: SpikeStream) -> StreamReport:
    """Count a whole stream and judge its pixels.

    A pixel is dead where it never fires while the median of its 5x5 neighbourhood would fire at least ten times. It is
    hot where its rate is more than HOT_SIGMA robust standard deviations of (rate - neighbourhood median), and at least
    half of that median, above it.
    """
    from scipy.ndimage import median_filter

    counts = np.zeros((stream.height, stream.width), np.int64)
    for start in range(0, stream.n_ticks, _LONGEST_WINDOW):
        counts += stream.counts(start, min(start + _LONGEST_WINDOW, stream.n_ticks))
    rate = counts / stream.n_ticks
    around = median_filter(rate, size=5, mode="nearest")
    excess = rate - around
    sigma = 1.4826 * float(np.median(np.abs(excess - np.median(excess))))
    dead = (counts == 0) & (around * stream.n_ticks >= 10)
    hot = (excess > HOT_SIGMA * max(sigma, 1 / stream.n_ticks)) & (excess > 0.5 * around)
    return StreamReport(name, rate, dead, hot, _two_intervals(stream), stream.rate_hz, stream.n_ticks)


def _two_intervals(stream: SpikeStream) -> float:
    """Share of the pixels with at least three spikes whose intervals are all k or k + 1.

    Steady light on a pixel that keeps the charge above the threshold gives exactly that: a test of the sensor model.
    """
    shape = stream.height, stream.width
    last, spikes = np.full(shape, -1), np.zeros(shape, np.int64)
    shortest, longest = np.full(shape, np.iinfo(np.int64).max), np.zeros(shape, np.int64)
    for start in range(0, min(stream.n_ticks, _INTERVAL_TICKS), 100):
        for t, fired in enumerate(stream.window(start, min(start + 100, stream.n_ticks)), start):
            again = (fired != 0) & (last >= 0)
            length = t - last[again]
            shortest[again] = np.minimum(shortest[again], length)
            longest[again] = np.maximum(longest[again], length)
            last[fired != 0] = t
            spikes += fired
    enough = spikes >= 3
    return float(np.mean(longest[enough] - shortest[enough] <= 1)) if enough.any() else float("nan")


def write_picture(path: Path, report: StreamReport, stream: SpikeStream) -> None:
    """Write one PNG: TFP and TFI of the middle of the clip, the map of bad pixels, and the histogram of rates."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    middle = stream.n_ticks // 2
    gain = float(np.percentile(report.rate, 99)) or 1.0  # shown as white; the scale of a raw recording is unknown
    aspect = stream.height / stream.width
    figure, axes = plt.subplots(2, 2, figsize=(12, 12 * aspect + 1.2), layout="constrained")
    for axis, name in zip(axes[0], ("tfp", "tfi"), strict=True):
        axis.imshow(encode_srgb(IMAGES[name](stream, [middle], gain)[0]), cmap="gray", vmin=0, vmax=255)
        axis.set_title(f"{name.upper()} at tick {middle}")
    _draw_bad_pixels(axes[1, 0], report)
    axes[1, 1].hist(report.rate.ravel(), bins=100, color="0.3")
    axes[1, 1].set(xlabel="spikes per tick", ylabel="pixels", title=f"Rates, mean {report.rate.mean():.4f}")
    for axis in axes.flat[:3]:
        axis.set_xticks([])
        axis.set_yticks([])
    figure.suptitle(f"{report.name}: {stream.n_ticks} ticks of {stream.width}x{stream.height} at {stream.rate_hz:g} Hz")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _draw_bad_pixels(axis: Any, report: StreamReport) -> None:
    axis.imshow(report.rate, cmap="gray")
    for mask, color, what in ((report.dead, "tab:blue", "dead"), (report.hot, "tab:red", "hot")):
        y, x = np.nonzero(mask)
        axis.scatter(x, y, s=12, facecolors="none", edgecolors=color, label=f"{len(x)} {what}")
    axis.legend(loc="lower right")
    axis.set_title("Mean rate, bad pixels circled")


def _print_reports(reports: list[StreamReport]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("stream", "ticks", "mean", "median", "p1", "p99", "spikes/s", "dead", "hot", "two ISIs")
    for r in reports:
        p1, p50, p99 = (f"{v:.4f}" for v in np.percentile(r.rate, (1, 50, 99)))
        per_second = f"{r.rate.mean() * r.rate_hz:.0f}"
        bad = f"{r.dead.sum()}", f"{r.hot.sum()}"
        table.add_row(
            r.name, f"{r.n_ticks}", f"{r.rate.mean():.4f}", p50, p1, p99, per_second, *bad, f"{r.two_intervals:.1%}"
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
            return open_stream_folder(path)
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
    """Show a scene's streams, or one raw stream: rates, dead and hot pixels, interval statistics, TFP and TFI pictures.

    Args:
        path: A scene folder, a folder of imported streams, or a headerless .dat file.
        width: Pixels per row of a .dat file.
        height: Rows of a .dat file.
        fps: Ticks per second of a .dat file.
        top_down: The first row of a .dat file is the top one (cameras of this kind store the bottom row first).
        out: Folder for the pictures, one PNG per stream.
        allow_gaps: Accept recordings with gaps.
    """
    reports = []
    for name, stream in _open(path, width, height, fps, top_down, allow_gaps).items():
        report = examine(name, stream)
        write_picture(out / f"{path.resolve().name if path.is_dir() else path.stem}" / f"{name}.png", report, stream)
        reports.append(report)
    _print_reports(reports)
    print(f"pictures: {out / (path.resolve().name if path.is_dir() else path.stem)}")
    return 0
