"""The plain parts of every figure: a canvas without a window, atomic writes, one colour per method, text that fits."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from spike4dgs.benchmark.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 110
TRUETYPE = 42  # text that can be searched and copied, in a kind of font that journals take
NO_HISTORY = {"Creator": None, "Producer": None, "CreationDate": None}  # the same figure gives the same bytes


def new_figure(
    size: tuple[float, float], layout: Literal["constrained", "compressed"] | None = "constrained", dpi: int = DPI
) -> Figure:
    """Return a figure of `size` inches, independent of pyplot's state and of a display; without layout where None."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=dpi, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure atomically, without the version of matplotlib."""
    with atomic_path(path) as part:
        figure.savefig(part, metadata={"Software": None})


def save_with_pdf(figure: Figure, path: Path) -> None:
    """Write a PNG, and beside it a PDF for papers: lines and text stay what they are, images keep their pixels."""
    from matplotlib import rc_context

    save_figure(figure, path)
    with rc_context({"pdf.fonttype": TRUETYPE}), atomic_path(path.with_suffix(".pdf")) as part:
        figure.savefig(part, metadata=NO_HISTORY)


def method_color(i: int) -> Any:
    """Return the colour of the i-th method: 60 differ."""
    from matplotlib import colormaps

    return colormaps[("tab20", "tab20b", "tab20c")[i // 20 % 3]](i % 20)


def wrap_name(name: str, width: int) -> list[str]:
    """Return the lines of a method's name, broken after + . _ and - where it is longer than `width` characters.

    >>> wrap_name("spk2img+colmap+spacetime", 16)
    ['spk2img+colmap+', 'spacetime']
    """
    lines = [""]
    for part in re.findall(rf"[^+._-]{{1,{width - 1}}}[+._-]?|[+._-]", name):
        if len(lines[-1] + part) > width:
            lines.append("")
        lines[-1] += part
    return lines


def text_width(figure: Figure, text: str, **style: Any) -> float:
    """Return the width of a line of text in inches."""
    shown = figure.text(0, 0, text, **style)
    width = shown.get_window_extent().width / figure.dpi
    shown.remove()
    return float(width)
