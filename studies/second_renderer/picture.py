"""The picture of the study: both renderers side by side, with maps of what they differ in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.benchmark.scene.images import encode_srgb, gray

_SCALE = 0.1  # of relative differences


@dataclass(frozen=True, eq=False)
class Row:
    """Linear RGB images [H, W, 3] of a world: by both renderers, as stored, and both of its grey twin."""

    world: str
    ours: Float32
    second: Float32
    stored: Float32
    grey: tuple[Float32, Float32]


def write_picture(path: Path, rows: Sequence[Row]) -> None:
    """Write a row for each world: our renderer, Cycles, as stored, and Cycles against ours, grey and whole."""
    figure = new_figure((14, 1.75 * len(rows) + 0.3))
    for axes, row in zip(figure.subplots(len(rows), 5, squeeze=False), rows, strict=True):
        images = (("ours", row.ours), ("Cycles", row.second), ("as stored", row.stored))
        for ax, (title, image) in zip(axes, images, strict=False):
            ax.imshow(encode_srgb(image))
            ax.set_title(f"{row.world}: {title}", fontsize=8)
        maps = (("grey flat faces, Cycles / ours - 1", row.grey), ("Cycles / ours - 1", (row.ours, row.second)))
        for ax, (title, pair) in zip(axes[3:], maps, strict=True):
            ours, second = map(gray, pair)
            ratio = second / np.maximum(ours, 1e-6) - 1
            shown = ax.imshow(ratio, cmap="RdBu_r", vmin=-_SCALE, vmax=_SCALE, interpolation="nearest")
            ax.set_title(title, fontsize=8)
            figure.colorbar(shown, ax=ax, shrink=0.7)
        for ax in axes:
            ax.set(xticks=[], yticks=[])
    save_figure(figure, path)
