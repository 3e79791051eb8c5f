"""Display of a capture: its states and spike rates while it runs, and a sheet of every camera's image."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.live import Live
from rich.table import Table

from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.generators.recorder.rig_profile import RigProfile
from spike4dgs.generators.recorder.sync import Rate

WINDOW_TICKS = 32  # of an image on the sheet
_BAR = 20  # characters for one spike per tick


class Watch:
    """Shows a capture: a line for each state, or with `live` a table that follows the cameras' rates.

    For example::

        with Watch(profile, live=True) as watch:
            clip = capture(profile, links, 0.5, on_state=watch.state, on_rate=watch.rates)
    """

    def __init__(self, profile: RigProfile, live: bool, console: Console | None = None) -> None:
        self._profile, self._live, self._console = profile, live, console or Console(width=100)
        self._state, self._rates = "", dict[str, Rate]()
        self._shown: Live | None = None

    def state(self, state: str) -> None:
        """Show that the capture has reached a state."""
        self._state = state
        if self._shown is None:
            self._console.print(state.lower())
        else:
            self._shown.update(self._table(), refresh=True)

    def rates(self, rates: Mapping[str, Rate]) -> None:
        """Show the cameras' current rates."""
        if not self._live:
            return
        self._rates.update(rates)
        if self._shown is None:
            # Shown when there are new rates: a thread of its own would take time from the cameras' threads.
            self._shown = Live(self._table(), console=self._console, auto_refresh=False)
            self._shown.start()
        self._shown.update(self._table(), refresh=True)

    def _table(self) -> Table:
        table = Table("camera", "MB/s", "ticks", "spikes/tick", "", "waiting", "lost ticks", title=self._state.lower())
        for camera in self._profile.cameras:
            r = self._rates.get(camera.id)
            if r is None:
                table.add_row(camera.id)
                continue
            known = not math.isnan(r.spikes_per_tick)
            rate, bar = (f"{r.spikes_per_tick:.4f}", "#" * round(_BAR * r.spikes_per_tick)) if known else ("-", "")
            speed, lost = f"{r.bytes_per_s / 1e6:.1f}", f"[red]{r.lost_ticks}" if r.lost_ticks else "0"
            table.add_row(camera.id, speed, f"{r.ticks}", rate, f"{bar:<{_BAR}}", f"{r.backlog}", lost)
        return table

    def __enter__(self) -> Watch:
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown is not None:
            self._shown.stop()
            if not self._console.is_terminal:  # there the last table has no end of line
                self._console.line()


def write_sheet(path: Path, streams: Mapping[str, SpikeStream]) -> None:
    """Write one PNG with an image of every camera: the spikes of `WINDOW_TICKS` ticks near the middle (TFP).

    One scale for all: white is the 99th percentile of all images. A camera without such a window free of gaps has an
    empty panel.
    """
    from matplotlib.figure import Figure

    streams = dict(sorted(streams.items()))
    images = {camera: middle_image(stream) for camera, stream in streams.items()}
    seen = [image for _, image in (p for p in images.values() if p is not None)]
    white = max(float(np.percentile(np.concatenate([i.ravel() for i in seen]), 99)), 1e-6) if seen else 1.0
    first = next(iter(streams.values()))
    side = math.ceil(math.sqrt(len(streams)))
    rows = math.ceil(len(streams) / side)
    figure = Figure(figsize=(12, 12 / side * rows * (first.height / first.width + 0.08) + 0.5), layout="constrained")
    for axes, (camera, stream) in zip(figure.subplots(rows, side, squeeze=False).flat, streams.items(), strict=False):
        image = images[camera]
        lost = sum(gap.ticks for gap in stream.gaps)
        title = f"{camera}, tick {image[0]}" if image else f"{camera}: no window without a gap"
        axes.set_title(title + (f", {lost} ticks lost" if lost else ""), fontsize=9)
        if image is not None:
            axes.imshow(encode_srgb(image[1] / np.float32(white)), cmap="gray", vmin=0, vmax=255)
    for axes in figure.axes:
        axes.axis("off")
    ms = first.n_ticks * 1e3 / first.rate_hz
    figure.suptitle(f"{first.n_ticks} ticks at {first.rate_hz:g} Hz ({ms:g} ms); white is {white:.3f} spikes per tick")
    with atomic_path(path) as part:
        figure.savefig(part, dpi=100)


def middle_image(stream: SpikeStream) -> tuple[int, NDArray[np.float32]] | None:
    """Return first tick and mean [H, W] of the window without a gap nearest the middle; None where there is none."""
    length = min(WINDOW_TICKS, stream.n_ticks)
    kept = np.concatenate([[0], np.cumsum(present(stream.gaps, stream.n_ticks))])
    starts = np.nonzero(kept[length:] - kept[:-length] == length)[0]
    if not len(starts):
        return None
    start = int(starts[np.argmin(np.abs(starts - (stream.n_ticks - length) // 2))])
    return start, stream.counts(start, start + length).astype(np.float32) / np.float32(length)
