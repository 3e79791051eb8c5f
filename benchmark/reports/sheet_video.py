"""The sheet as a video: the same crops and errors of every method side by side, through the clip and slowed down."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.reports.error_map import scale_name
from spike4dgs.benchmark.reports.figure import wrap_name
from spike4dgs.benchmark.reports.panels import Panels, make_panels
from spike4dgs.benchmark.reports.video import video_writer
from spike4dgs.benchmark.runs.record import Record
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import Scene

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont

FPS = 8  # images a second, so that each can be looked at
WIDEST = 1700  # pixels of a frame
PANEL = 230  # about the width of a panel in pixels; images are enlarged by whole numbers, so that pixels stay pixels
TALLEST = 330
GAP, LINE, FONT = 6, 18, 12  # pixels
GROUND, TEXT = 18, 235  # gray values
OUTLINE = (23, 190, 207)  # that of the sheet


@dataclass(frozen=True)
class Layout:
    """Where the panels are: pixels. A cell has the lines of a name, a line for its scale, an image, and its errors."""

    panel: tuple[int, int]  # width and height
    head: int  # lines of the longest name
    zoom: int
    columns: int
    cells: int
    foot: int  # lines of the legend

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frames, both even."""
        width = GAP + self.columns * (self.panel[0] + GAP)
        height = GAP + math.ceil(self.cells / self.columns) * self.cell_height + self.foot * LINE + GAP
        return width + width % 2, height + height % 2

    @property
    def cell_height(self) -> int:
        """Pixels from one row of cells to the next."""
        return (self.head + 1) * LINE + 2 * (self.panel[1] + GAP)

    def corner(self, cell: int) -> tuple[int, int]:
        """Return the upper left corner (x, y) of a cell."""
        return GAP + cell % self.columns * (self.panel[0] + GAP), GAP + cell // self.columns * self.cell_height

    def image(self, cell: int) -> tuple[slice, slice]:
        """Return the rows and columns of a cell's image."""
        x, y = self.corner(cell)
        top = y + (self.head + 1) * LINE
        return slice(top, top + self.panel[1]), slice(x, x + self.panel[0])

    def errors(self, cell: int) -> tuple[slice, slice]:
        """Return the rows and columns of a cell's error map."""
        rows, columns = self.image(cell)
        below = self.panel[1] + GAP
        return slice(rows.start + below, rows.stop + below), columns


def write_sheet_video(path: Path, scene: Scene, folders: Mapping[str, Path], records: Sequence[Record]) -> None:
    """Write a video of what `write_sheet` shows, through all scored images of the same camera.

    Methods without images are left out. Raises UserError where OpenCV has no encoder.
    """
    panels = make_panels(scene, folders, records)
    layout = make_layout(panels)
    ground = _ground(panels, layout)
    with video_writer(path, layout.size, FPS, gray=False) as write:
        for k in range(len(panels.targets)):
            write(_frame(panels, layout, ground, k))


def make_layout(panels: Panels) -> Layout:
    """Return where the truth, cell 0, and the methods with images are."""
    w, h = panels.size
    zoom = max(1, min(round(PANEL / w), TALLEST // h))
    cells = 1 + len(panels.scored)
    most = max(1, (WIDEST - GAP) // (w * zoom + GAP))
    head = max(len(_name(name, w * zoom)) for name in ("ground truth", *panels.scored))
    layout = Layout((w * zoom, h * zoom), head, zoom, math.ceil(cells / math.ceil(cells / most)), cells, 0)
    return replace(layout, foot=len(_legend(panels, layout.size[0])))


def _name(name: str, width: int) -> list[str]:
    """Return the lines of a name that fit into `width` pixels."""
    characters = int(width / _font(FONT).getlength("n"))
    return wrap_name(name, max(8, characters))


def _frame(panels: Panels, layout: Layout, ground: UInt8, k: int) -> UInt8:
    frame = ground.copy()
    for cell, name in enumerate([None, *panels.scored]):
        frame[layout.image(cell)] = _enlarged(panels.image(name, k), layout.zoom)[..., None]
        frame[layout.errors(cell)] = (
            _whole(panels, layout, k) if name is None else _enlarged(panels.errors(name, k), layout.zoom)
        )
    x, y = layout.corner(0)
    return _with_text(
        frame, [(x, y + layout.head * LINE, f"{panels.scene.t_us(panels.targets[k].tick) / 1000:.2f} ms")]
    )


def _enlarged(image: UInt8, zoom: int) -> UInt8:
    return image.repeat(zoom, 0).repeat(zoom, 1)


def _whole(panels: Panels, layout: Layout, k: int) -> UInt8:
    """Return the whole image with the crop's outline, as large as a panel holds, RGB [h, w, 3]."""
    import cv2

    width, height = layout.panel
    whole, box = encode_srgb(panels.scene.ground_truth(panels.targets[k])), panels.boxes[k]
    factor = min(width / whole.shape[1], height / whole.shape[0])
    size = max(1, int(whole.shape[1] * factor)), max(1, int(whole.shape[0] * factor))
    small = cv2.resize(whole, size, interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_NEAREST)
    out = np.full((height, width, 3), GROUND, np.uint8)
    out[: size[1], : size[0]] = small[..., None]
    if panels.is_cropped:
        ends = [(box.x, box.y), (box.x + box.width, box.y + box.height)]
        first, last = ([min(int(v * factor), s - 1) for v, s in zip(end, size, strict=True)] for end in ends)
        cv2.rectangle(out, first, last, OUTLINE, 1)
    return out


def _ground(panels: Panels, layout: Layout) -> UInt8:
    """Return a frame with all text that does not change."""
    lines = []
    for cell, name in enumerate([None, *panels.scored]):
        x, y = layout.corner(cell)
        lines += [(x, y + n * LINE, line) for n, line in enumerate(_name(name or "ground truth", layout.panel[0]))]
        if name is not None:
            lines.append(
                (x, y + layout.head * LINE, f"{scale_name(panels.scales[name])}: 0 to {panels.scales[name]:g}")
            )
    width, height = layout.size
    for n, line in enumerate(_legend(panels, width)):
        lines.append((GAP, height - GAP - (layout.foot - n) * LINE, line))
    return _with_text(np.full((height, width, 3), GROUND, np.uint8), lines)


def _legend(panels: Panels, width: int) -> list[str]:
    """Return the lines of the legend that fit into `width` pixels."""
    legend = f"{_speed(panels)}Errors: |render - truth| of linear radiance, black is 0, 1 is white in the image."
    return textwrap.wrap(legend, int(width / _font(FONT).getlength("n")))


def _speed(panels: Panels) -> str:
    ticks = [t.tick for t in panels.targets]
    if len(ticks) < 2:
        return ""
    step_us = (panels.scene.t_us(ticks[-1]) - panels.scene.t_us(ticks[0])) / (len(ticks) - 1)
    return f"{panels.scene.id}, {panels.targets[0].camera}: slowed down {1e6 / FPS / step_us:.0f} times. "


def _with_text(frame: UInt8, lines: Sequence[tuple[int, int, str]]) -> UInt8:
    """Return a frame with lines of text, each from its upper left corner (x, y)."""
    from PIL import Image, ImageDraw

    image = Image.fromarray(frame)
    draw = ImageDraw.Draw(image)
    for x, y, text in lines:
        draw.text((x, y), text, fill=(TEXT, TEXT, TEXT), font=_font(FONT))
    return np.asarray(image).copy()


@cache
def _font(size: int) -> FreeTypeFont:
    """Return matplotlib's own font: it is there on every machine."""
    from matplotlib.font_manager import findfont
    from PIL import ImageFont

    return ImageFont.truetype(findfont("DejaVu Sans"), size)
