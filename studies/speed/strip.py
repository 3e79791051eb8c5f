"""The strip of a scene: truth and each maker's image side by side, with error maps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.error_map import show_error, show_error_scale
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.studies.speed.rows import Row, held_out, middle_target

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def write_strip(path: Path, scene: Scene, makers: Sequence[tuple[Row, ImageMaker]]) -> None:
    """Write a PNG of the middle target: truth and the image of each maker, error maps below."""
    target = middle_target(scene)
    truth = scene.ground_truth(target)
    width = 2.8
    size = (width * (len(makers) + 1), 2 * width * scene.meta["height"] / scene.meta["width"] + 0.7)
    figure = new_figure(size, "compressed")
    axes = figure.subplots(2, len(makers) + 1, squeeze=False)
    for ax in axes.flat:
        ax.axis("off")
    _show(axes[0, 0], f"truth, {scene.id}, tick {target.tick}", truth)
    for (top, below), (row, maker) in zip(axes[:, 1:].T, makers, strict=True):
        stream, tick, gain = held_out(scene, target)
        image = maker(stream, [tick], gain)[0]
        psnr = METRICS["psnr"].format(row.quality[scene.id]["psnr"])
        _show(top, f"{row.name}, {psnr} dB over the scene", image)
        show_error(below, image, truth)
    if makers:
        show_error_scale(axes[1, 0])
    save_figure(figure, path)


def _show(ax: Axes, title: str, image: Float32) -> None:
    ax.set_title(title, fontsize=8)
    ax.imshow(encode_srgb(image), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
