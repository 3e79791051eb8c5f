"""The plain parts of every figure: a canvas without a window, an atomic write, one colour per method."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from spike4dgs.benchmark.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def new_figure(size: tuple[float, float], layout: Literal["constrained", "compressed"] = "constrained") -> Figure:
    """Return a figure of `size` inches, independent of pyplot's state and of a display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=110, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure atomically, without the version of matplotlib."""
    with atomic_path(path) as part:
        figure.savefig(part, metadata={"Software": None})


def method_color(i: int) -> Any:
    """Return the colour of the i-th method."""
    from matplotlib import colormaps

    return colormaps["tab20"](i % 20)
