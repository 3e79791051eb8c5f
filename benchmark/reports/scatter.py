"""Scatter of quality against fit time, and plots of quality against the number of training views."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.figure import method_color, new_figure, save_figure
from spike4dgs.benchmark.results.record import Record


def write_scatter(path: Path, records: Sequence[Record]) -> None:
    """Write a PNG: PSNR of the whole image and of the moving region against fit time, a point per method and scene.

    A colour is a method, a marker a scene.
    """
    figure = new_figure((10.5, 4.4))
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
                    ax.scatter(seconds, cell["metrics"][metric], color=method_color(i), marker=marker, s=60)
                    shown |= {record["method"]["name"], scene}
        ax.set_xscale("log")
        ax.set_xlabel("fit time, s")
        ax.set_ylabel(f"{METRICS[metric].title}, {METRICS[metric].unit}")
        ax.grid(alpha=0.3)
    if shown:
        keys = {r["method"]["name"]: ("o", method_color(i)) for i, r in enumerate(records)}
        keys |= {scene: (marker, "gray") for scene, marker in markers.items()}
        lines = {n: ax.plot([], [], marker, color=c)[0] for n, (marker, c) in keys.items() if n in shown}
        figure.legend(lines.values(), lines.keys(), loc="outside right upper", fontsize=8)
    save_figure(figure, path)


def write_views(path: Path, table: Mapping[str, Any]) -> None:
    """Write a PNG of a table whose columns are splits `views-N`: each metric against N, measured above published."""
    metrics, scenes = [m["id"] for m in table["metrics"]], table["scenes"]
    figure = new_figure((3.4 * len(metrics), 6.4))
    axes = figure.subplots(2, len(metrics), squeeze=False)
    for row, kind in zip(axes, ("value", "published"), strict=True):
        for ax, metric in zip(row, metrics, strict=True):
            for i, method in enumerate(table["rows"]):
                cells = {int(s.split("-")[-1]): method["scenes"][k]["values"][metric][kind] for k, s in scenes.items()}
                known = {n: v for n, v in cells.items() if v is not None}
                if known:
                    ax.plot(known.keys(), known.values(), "o-", color=method_color(i), label=method["method"])
            ax.set_title(f"{METRICS[metric].title}, {'measured' if kind == 'value' else 'published'}", fontsize=9)
            ax.set_xlabel("training views")
            ax.set_visible(bool(ax.lines))
    handles = {label: h for ax in axes.flat for h, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    if handles:
        figure.legend(handles.values(), handles.keys(), loc="outside right upper", fontsize=8)
    save_figure(figure, path)
