"""What people look at after a run: the table, the image sheets, the scatter of quality against time."""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.metrics.table import METRICS, Metric
from spike4dgs.benchmark.results.record import COSTS, Cell, Record
from spike4dgs.benchmark.scene.images import encode_srgb, read_exr
from spike4dgs.benchmark.scene.scene import Scene, Target

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ERROR_MAX = 0.3  # the error maps' white: larger errors look the same


def make_console() -> Console:
    """A console; where the output is no terminal, one that is wide enough for the table."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=180)


def results_table(records: Sequence[Record]) -> Table:
    """All records as a table: one block per scene and one for the mean; the best value of a block is bold.

    Metrics that no scene of any record has are left out.
    """
    splits = ", ".join(sorted({r["dataset"]["split"] for r in records}))
    cells = [cell for r in records for cell in r["scenes"].values()]
    metrics = [m for m in METRICS.values() if any(c["metrics"][m.id] is not None for c in cells)]
    lower = ", ".join(m.id for m in metrics if not m.higher_is_better)
    caption = f"higher is better{f', except {lower}' if lower else ''}; a dash is a value that does not exist"
    table = Table(title=f"Results, split {splits}", caption=caption, box=None)
    table.add_column("scene")
    table.add_column("method")
    for m in metrics:
        table.add_column(m.id.replace("_", "\n"), justify="right")
    for title, _ in COSTS.values():
        table.add_column(title.replace(", ", "\n"), justify="right")
    scenes = list(dict.fromkeys(s for r in records for s in r["scenes"]))
    for scene in scenes:
        named = [(r["method"]["name"], r["scenes"][scene]) for r in records if scene in r["scenes"]]
        _add_block(table, scene, metrics, [(name, cell["metrics"], cell) for name, cell in named])
    if len(scenes) > 1:
        _add_block(table, "mean", metrics, [(r["method"]["name"], r["mean"], {}) for r in records])
    return table


def _add_block(
    table: Table,
    title: str,
    metrics: Sequence[Metric],
    rows: list[tuple[str, dict[str, float | None], Mapping[str, Any]]],
) -> None:
    best: dict[str, float] = {}
    for m in metrics:
        known = [v for _, values, _ in rows if (v := values[m.id]) is not None]
        if known:
            best[m.id] = max(known) if m.higher_is_better else min(known)
    for i, (name, values, cell) in enumerate(rows):
        texts = []
        for m in metrics:
            text = m.format(values[m.id])
            texts.append(f"[bold]{text}[/bold]" if len(rows) > 1 and values[m.id] == best.get(m.id, "") else text)
        costs = ["" if cell.get(k) is None else f"{cell[k]:.{digits}f}" for k, (_, digits) in COSTS.items()]
        status = cell.get("status", "ok")
        shown = escape(name) + (f" [red]({status})[/red]" if status != "ok" else "")
        table.add_row(escape(title) if i == 0 else "", shown, *texts, *costs, end_section=i == len(rows) - 1)


def cell_summary(cell: Cell) -> str:
    """One line about a cell."""
    if cell["status"] != "ok":
        return f"{cell['status']}: {cell['error']}"
    ids = ("psnr", "ssim", "psnr_dynamic", "ssim_dynamic", "flip")
    shown = [f"{k} {METRICS[k].format(cell['metrics'][k])}" for k in ids]
    costs = [("fit", "fit_seconds", "s"), ("render", "render_fps", "images/s"), ("peak", "peak_memory_mb", "MB")]
    shown += [f"{name} {cell[k]:.1f} {unit}" for name, k, unit in costs if cell[k] is not None]
    return ", ".join(shown)


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
    figure = _figure(size, "compressed")
    axes = figure.subplots(2 * len(targets), len(names) + 1, squeeze=False)
    for row, target in enumerate(targets):
        truth, moving = scene.ground_truth(target), scene.moving(target)
        top, below = axes[2 * row], axes[2 * row + 1]
        _show(top[0], encode_srgb(truth), moving)
        top[0].set_title(f"ground truth, {scene.t_us(target.tick) / 1000:.1f} ms", fontsize=9)
        bar = below[0]
        for ax, ax_below, name in zip(top[1:], below[1:], names, strict=True):
            cell = cells[name]
            if cell["status"] != "ok":
                _say(ax, name, f"{cell['status']}: {cell['error']}")
                ax_below.axis("off")
                continue
            prediction = read_exr(folders[name] / f"{target.name}.exr")
            _show(ax, encode_srgb(prediction), moving)
            values = cell["per_image"][target.name]
            psnr, dynamic = METRICS["psnr"], METRICS["psnr_dynamic"]
            text = f"{psnr.format(values['psnr'])} dB, moving {dynamic.format(values['psnr_dynamic'])} dB"
            ax.set_title(f"{name}\n{text}", fontsize=9)
            error = np.abs(np.clip(prediction, 0, 1) - np.clip(truth, 0, 1))
            _show(ax_below, error, moving, cmap="magma", vmax=_ERROR_MAX)
        _error_scale(bar)
    figure.suptitle(f"{scene.id}: camera {targets[0].camera}, moving region outlined", fontsize=11)
    _save(figure, path)


def pick_targets(scene: Scene, count: int = 3) -> list[Target]:
    """Targets of the first held-out camera, spread over the clip without its ends."""
    targets = sorted(t for t in scene.targets if t.camera == min(t.camera for t in scene.targets))
    positions = (np.arange(min(count, len(targets))) + 0.5) / min(count, len(targets)) * len(targets)
    return [targets[int(p)] for p in positions]


def write_scatter(path: Path, records: Sequence[Record]) -> None:
    """Write a PNG: PSNR of the whole image and of the moving region against fit time, a point per method and scene.

    A colour is a method, a marker a scene.
    """
    figure = _figure((10.5, 4.4))
    markers = dict(
        zip(dict.fromkeys(s for r in records for s in r["scenes"]), itertools.cycle("osD^vP*X"), strict=False)
    )
    shown: set[str] = set()
    for ax, metric in zip(figure.subplots(1, 2), ("psnr", "psnr_dynamic"), strict=True):
        for i, record in enumerate(records):
            for scene, marker in markers.items():
                cell = record["scenes"].get(scene)
                if cell and cell["metrics"][metric] is not None and cell["fit_seconds"] is not None:
                    seconds = max(cell["fit_seconds"], 1e-3)  # a logarithm needs more than zero
                    ax.scatter(seconds, cell["metrics"][metric], color=_color(i), marker=marker, s=60)
                    shown |= {record["method"]["name"], scene}
        ax.set_xscale("log")
        ax.set_xlabel("fit time, s")
        ax.set_ylabel(f"{METRICS[metric].title}, {METRICS[metric].unit}")
        ax.grid(alpha=0.3)
    if shown:
        keys = {r["method"]["name"]: ("o", _color(i)) for i, r in enumerate(records)}
        keys |= {scene: (marker, "gray") for scene, marker in markers.items()}
        lines = {n: ax.plot([], [], marker, color=c)[0] for n, (marker, c) in keys.items() if n in shown}
        figure.legend(lines.values(), lines.keys(), loc="outside right upper", fontsize=8)
    _save(figure, path)


def write_views(path: Path, table: Mapping[str, Any]) -> None:
    """Write a PNG of a table whose columns are splits `views-N`: each metric against N, measured above published."""
    metrics, scenes = [m["id"] for m in table["metrics"]], table["scenes"]
    figure = _figure((3.4 * len(metrics), 6.4))
    axes = figure.subplots(2, len(metrics), squeeze=False)
    for row, kind in zip(axes, ("value", "published"), strict=True):
        for ax, metric in zip(row, metrics, strict=True):
            for i, method in enumerate(table["rows"]):
                cells = {int(s.split("-")[-1]): method["scenes"][k]["values"][metric][kind] for k, s in scenes.items()}
                known = {n: v for n, v in cells.items() if v is not None}
                if known:
                    ax.plot(known.keys(), known.values(), "o-", color=_color(i), label=method["method"])
            ax.set_title(f"{METRICS[metric].title}, {'measured' if kind == 'value' else 'published'}", fontsize=9)
            ax.set_xlabel("training views")
            ax.set_visible(bool(ax.lines))
    handles = {label: h for ax in axes.flat for h, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    if handles:
        figure.legend(handles.values(), handles.keys(), loc="outside right upper", fontsize=8)
    _save(figure, path)


def _color(i: int) -> Any:
    """The colour of the i-th method."""
    from matplotlib import colormaps

    return colormaps["tab20"](i % 20)


def _figure(size: tuple[float, float], layout: Literal["constrained", "compressed"] = "constrained") -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=110, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, path: Path) -> None:
    with atomic_path(path) as part:
        figure.savefig(part, metadata={"Software": None})


def _show(ax: Axes, image: Any, moving: Any, cmap: str = "gray", vmax: float = 255) -> None:
    ax.imshow(image, cmap=cmap, vmin=0, vmax=vmax, interpolation="nearest")
    if moving.any() and not moving.all():
        ax.contour(moving, levels=[0.5], colors="tab:cyan", linewidths=0.7)
    ax.set_xticks([])
    ax.set_yticks([])


def _say(ax: Axes, name: str, text: str) -> None:
    ax.set_title(name, fontsize=9)
    ax.text(0.5, 0.5, textwrap.fill(text[:240], 36), ha="center", va="center", fontsize=7, transform=ax.transAxes)
    ax.axis("off")


def _error_scale(ax: Axes) -> None:
    """The error maps' colours, in the place where the ground truth's error map would be."""
    ax.axis("off")
    scale = ax.inset_axes((0.08, 0.45, 0.84, 0.14))
    scale.imshow(np.linspace(0, 1, 256)[None], cmap="magma", aspect="auto", extent=(0, _ERROR_MAX, 0, 1))
    scale.set_yticks([])
    scale.tick_params(labelsize=7)
    scale.set_xlabel("absolute error (1 = white)", fontsize=8)
