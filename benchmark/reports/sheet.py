"""The sheet of a scene: a row for the truth and for every method, crops of what moves at a few times, with errors.

Sizes are in inches and every part has its place, so that a sheet of many methods grows and nothing is cut off.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.reports.error_map import COLORS, ERROR_MAX, scale_name
from spike4dgs.benchmark.reports.figure import new_figure, save_with_pdf, text_width, wrap_name
from spike4dgs.benchmark.reports.panels import Panels, make_panels, score_text
from spike4dgs.benchmark.runs.record import Record
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PANEL = 1.5  # width of a panel; a tall one is narrower
TALLEST = 1.8  # height of a panel
MARGIN, GAP, BETWEEN = 0.1, 0.03, 0.14  # at the page's edge, between image and error, between two instants
HEAD, FOOT, LINE, BELOW = 0.5, 0.4, 0.14, 0.22  # title, legend, a line of text, scores below a row
SCALE = 0.62  # the colour bar with its numbers
NAME = 22  # characters in a line of a method's name
LARGE, SMALL = 8.0, 6.5  # points
INK = "tab:cyan"  # the outline of the crop and of what moves
LEGEND = (
    "error: |render - truth| of linear radiance, 1 is white, on the scale beside each row "
    f"(\N{MULTIPLICATION SIGN}1: 0 to {ERROR_MAX:g}); larger errors look the same"
)


def write_sheet(path: Path, scene: Scene, folders: Mapping[str, Path], records: Sequence[Record]) -> None:
    """Write a PNG and a PDF: truth and every method at a few instants, cropped to what moves, errors beside.

    The whole picture with the crop's outline stands beside the truth. `folders` maps a method to its predictions of
    this scene; a method without values gets a row that says why.
    """
    save_with_pdf(make_sheet(make_panels(scene, folders, records)), path)


@dataclass(frozen=True)
class _Page:
    """A figure with what places its parts: inches from the left and from the top."""

    figure: Figure
    left: float  # of the first panel
    panel: tuple[float, float]  # width and height
    instants: int

    @property
    def right(self) -> float:
        """The right edge of the last panel."""
        return self.column(self.instants - 1) + 2 * self.panel[0] + GAP

    def column(self, k: int) -> float:
        """Return the left edge of an instant."""
        return self.left + k * (2 * self.panel[0] + GAP + BETWEEN)

    def axes(self, x: float, y: float, width: float, height: float) -> Axes:
        """Return axes without ticks whose upper left corner is at (x, y)."""
        w, h = self.figure.get_size_inches()
        axes = self.figure.add_axes((x / w, 1 - (y + height) / h, width / w, height / h))
        axes.set(xticks=[], yticks=[])
        return axes

    def text(self, x: float, y: float, text: str, **style: Any) -> None:
        """Write a line of text whose upper left corner is at (x, y)."""
        w, h = self.figure.get_size_inches()
        self.figure.text(x / w, 1 - y / h, text, **{"va": "top", "fontsize": SMALL, **style})


def make_sheet(panels: Panels) -> Figure:
    """Return the sheet as a figure."""
    rows: list[str | None] = [None, *panels.folders]
    crop_w, crop_h = panels.size
    width = min(PANEL, TALLEST * crop_w / crop_h)
    panel = (width, width * crop_h / crop_w)
    row_height = max(panel[1], 3 * LINE) + BELOW
    page = _lay_out(panels, panel, HEAD + len(rows) * row_height + FOOT)
    camera = panels.targets[0].camera
    title = f"{panels.scene.id}, {camera}: what moves" if panels.is_cropped else f"{panels.scene.id}, {camera}"
    page.text(MARGIN, MARGIN, title, fontsize=LARGE + 2, weight="bold")
    for i, name in enumerate(rows):
        y = HEAD + i * row_height
        _label(page, name, y)
        if name is None:
            _truth(page, panels, y)
        elif panels.cells[name]["status"] == "ok":
            _method(page, panels, name, y)
        else:
            _reason(page, f"{panels.cells[name]['status']}: {panels.cells[name]['error']}", y)
    for n, line in enumerate(textwrap.wrap(LEGEND, int((page.right - MARGIN) / 0.055))):
        page.text(MARGIN, HEAD + len(rows) * row_height + n * LINE, line)
    return page.figure


def _lay_out(panels: Panels, panel: tuple[float, float], height: float) -> _Page:
    scratch = new_figure((1, 1), None)
    lines = [line for name in ("ground truth", *panels.folders) for line in wrap_name(name, NAME)]
    widths = [text_width(scratch, line, fontsize=LARGE, weight="bold") for line in lines]
    page = _Page(scratch, MARGIN + max(widths) + MARGIN, panel, len(panels.shown))
    figure = new_figure((page.right + SCALE + MARGIN, height), None, dpi=200)
    return _Page(figure, page.left, panel, page.instants)


def _label(page: _Page, name: str | None, y: float) -> None:
    lines = ["ground truth"] if name is None else wrap_name(name, NAME)
    for n, line in enumerate(lines):
        page.text(MARGIN, y + n * LINE, line, fontsize=LARGE, weight="bold")


def _truth(page: _Page, panels: Panels, y: float) -> None:
    """Show the truth's crops, the outline of what moves in them, and the whole pictures."""
    width, height = page.panel
    for column, k in enumerate(panels.shown):
        x, target, box = page.column(column), panels.targets[k], panels.boxes[k]
        page.text(x, y - LINE, f"{panels.scene.t_us(target.tick) / 1000:.1f} ms", fontsize=LARGE)
        axes = page.axes(x, y, width, height)
        _show(axes, panels.image(None, k))
        moving = panels.scene.moving(target)
        if moving.any() and not moving.all():
            axes.contour(box.of(moving), levels=[0.5], colors=INK, linewidths=0.7)
            page.text(x, y + height + 0.02, "moving region")
        if panels.is_cropped:
            _whole(page.axes(x + width + GAP, y, width, height), panels, k)
            page.text(x + width + GAP, y + height + 0.02, "whole image and crop")


def _whole(axes: Axes, panels: Panels, k: int) -> None:
    from matplotlib.patches import Rectangle

    box = panels.boxes[k]
    _show(axes, encode_srgb(panels.scene.ground_truth(panels.targets[k])))
    axes.set_anchor("NW")
    corner = (box.x - 0.5, box.y - 0.5)
    axes.add_patch(Rectangle(corner, box.width, box.height, fill=False, edgecolor=INK, linewidth=1, clip_on=False))
    axes.set_frame_on(False)


def _method(page: _Page, panels: Panels, name: str, y: float) -> None:
    """Show a method's crops, their errors, and the scale of these."""
    width, height = page.panel
    scores = panels.cells[name]["per_image"]
    for column, k in enumerate(panels.shown):
        x = page.column(column)
        _show(page.axes(x, y, width, height), panels.image(name, k))
        _show(page.axes(x + width + GAP, y, width, height), panels.errors(name, k))
        page.text(x, y + height + 0.02, "PSNR " + score_text(scores[panels.targets[k].name]))
    scale = panels.scales[name]
    bar = page.axes(page.right + 0.06, y, 0.09, height)
    bar.imshow(np.linspace(1, 0, 256)[:, None], cmap=COLORS, aspect="auto", extent=(0, 1, 0, scale))
    bar.yaxis.tick_right()
    bottom, top = bar.set_yticks([0, scale], labels=["0", f"{scale:g}"], fontsize=SMALL)
    bottom.label2.set_verticalalignment("bottom")
    top.label2.set_verticalalignment("top")
    bar.tick_params(length=2, pad=1)
    page.text(page.right + 0.06, y + height + 0.02, scale_name(scale))


def _reason(page: _Page, text: str, y: float) -> None:
    """Say why a method has no images; a long reason ends with dots."""
    characters, lines = int((page.right - page.left) / 0.055), max(2, int(page.panel[1] / LINE))
    shown = textwrap.wrap(text, characters, max_lines=lines, placeholder=" ...")
    for n, line in enumerate(shown):
        page.text(page.left, y + n * LINE, line)


def _show(axes: Axes, image: UInt8) -> None:
    # Interpolation "none" keeps the pixels in a PDF; "nearest" would sample them again.
    axes.imshow(image, cmap="gray", vmin=0, vmax=255, interpolation="none")
    for spine in axes.spines.values():
        spine.set_visible(False)
