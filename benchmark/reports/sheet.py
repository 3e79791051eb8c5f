"""The sheet of a scene: ground truth and every method side by side, with error maps."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.error_map import show_error, show_error_scale
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.benchmark.results.record import Record
from spike4dgs.benchmark.scene.images import Float32, encode_srgb, read_exr
from spike4dgs.benchmark.scene.scene import Scene, Target

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def write_sheet(path: Path, scene: Scene, folders: Mapping[str, Path], records: Sequence[Record]) -> None:
    """Write a PNG: ground truth and every method side by side at a few ticks, error maps below, motion outlined.

    `folders` maps a method to its predictions of this scene; a method without values gets a panel that says why.
    """
    names = list(folders)
    cells = {r["method"]["name"]: r["scenes"][scene.id] for r in records}
    targets = pick_targets(scene)
    camera = scene.cameras[targets[0].camera]
    width = 2.7
    height = width * camera.height / camera.width
    size = (width * (len(names) + 1), len(targets) * (2 * height + 0.5) + 0.6)
    figure = new_figure(size, "compressed")
    axes = figure.subplots(2 * len(targets), len(names) + 1, squeeze=False)
    for row, target in enumerate(targets):
        truth, moving = scene.ground_truth(target), scene.moving(target)
        top, below = axes[2 * row], axes[2 * row + 1]
        _show(top[0], truth, moving)
        top[0].set_title(f"ground truth, {scene.t_us(target.tick) / 1000:.1f} ms", fontsize=9)
        for ax, ax_below, name in zip(top[1:], below[1:], names, strict=True):
            cell = cells[name]
            if cell["status"] != "ok":
                _show_reason(ax, name, f"{cell['status']}: {cell['error']}")
                ax_below.axis("off")
                continue
            prediction = read_exr(folders[name] / f"{target.name}.exr", truth.shape)
            _show(ax, prediction, moving)
            values = cell["per_image"][target.name]
            psnr, dynamic = METRICS["psnr"], METRICS["psnr_dynamic"]
            text = f"{psnr.format(values['psnr'])} dB, moving {dynamic.format(values['psnr_dynamic'])} dB"
            ax.set_title(f"{name}\n{text}", fontsize=9)
            show_error(ax_below, prediction, truth)
            _outline(ax_below, moving)
        show_error_scale(below[0])
    figure.suptitle(f"{scene.id}: camera {targets[0].camera}, moving region outlined", fontsize=11)
    save_figure(figure, path)


def pick_targets(scene: Scene, count: int = 3) -> list[Target]:
    """Return targets of the first held-out camera, spread over the clip without its ends."""
    targets = sorted(t for t in scene.targets if t.camera == min(t.camera for t in scene.targets))
    positions = (np.arange(min(count, len(targets))) + 0.5) / min(count, len(targets)) * len(targets)
    return [targets[int(p)] for p in positions]


def _show(ax: Axes, image: Float32, moving: NDArray[np.bool_]) -> None:
    ax.imshow(encode_srgb(image), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    _outline(ax, moving)


def _outline(ax: Axes, moving: NDArray[np.bool_]) -> None:
    if moving.any() and not moving.all():
        ax.contour(moving, levels=[0.5], colors="tab:cyan", linewidths=0.7)
    ax.set_xticks([])
    ax.set_yticks([])


def _show_reason(ax: Axes, name: str, text: str) -> None:
    ax.set_title(name, fontsize=9)
    ax.text(0.5, 0.5, textwrap.fill(text[:240], 36), ha="center", va="center", fontsize=7, transform=ax.transAxes)
    ax.axis("off")
