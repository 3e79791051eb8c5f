"""`spike-agreement`: do the metrics of spikes order methods as PSNR against the truth does?

On each scene with ground truth: Spearman's rank correlation, over the methods of finished runs, of every metric of
spikes with PSNR, and of those of the moving region with the PSNR there. 1 is the same order.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import write_json, write_text
from spike4dgs.benchmark.metrics.measure import Values, select_metrics
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.benchmark.reports.figure import method_color, new_figure, save_figure
from spike4dgs.benchmark.runs.held_out import SPIKE_METRICS, has_truth
from spike4dgs.benchmark.runs.score import open_for, score_scene
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.studies.kit.timing import markdown, write_csv

FEWEST = 3  # methods with two values, of which an order says something
Scores = dict[str, dict[str, Values]]  # scene -> method -> metrics
Correlations = dict[str, dict[str, float | None]]  # metric of spikes -> scene -> rank correlation


def partner(metric: str) -> str:
    """Return the metric of the truth that a metric of spikes stands for."""
    return "psnr_dynamic" if metric.endswith("_dynamic") else "psnr"


def spike_agreement(
    runs: Positional[tuple[Path, ...]],
    *,
    data: Path = Path("data"),
    out: Path = Path("runs/spike-agreement"),
    allow_gaps: bool = False,
) -> int:
    """Measure how well the metrics of a held-out camera's own spikes order methods, against PSNR.

    Args:
        runs: Folders of run-benchmark, with predictions/METHOD/SCENE.
        data: Folder of the scenes.
        out: Folder for agreement.md, .csv, .json and .png.
        allow_gaps: Accept recordings with gaps.
    """
    console, scores, scenes = make_console(), Scores(), dict[str, Scene | None]()
    for folder in _prediction_folders(runs):
        name, method = folder.name, folder.parent.name
        if method in scores.get(name, {}):
            fix = "name one of the two runs"
            raise problem(folder, f"one run of {method} on {name}", "another one", fix)
        try:
            if name not in scenes:
                scenes[name] = None
                scenes[name] = open_scene(data / name, allow_gaps)
            if (scene := scenes[name]) is not None and has_truth(scene):
                scores.setdefault(name, {})[method] = _score(folder, scene)
        except UserError as e:
            console.print(f"left out: {method} on {name}: {e}", highlight=False, markup=False)
    if not scores:
        fix = "name folders of run-benchmark, and with --data the folder of their scenes"
        raise problem("runs", "predictions/METHOD/SCENE of scenes with ground truth", "none", fix)
    found = correlations(scores)
    write_text(out / "agreement.md", to_markdown(found, scores))
    ids = [*next(iter(next(iter(scores.values())).values()))]
    rows = ([scene, method, *(v[i] for i in ids)] for scene, of in scores.items() for method, v in of.items())
    write_csv(out / "agreement.csv", ["scene", "method", *ids], rows)
    write_json(out / "agreement.json", {"correlations": found, "mean": means(found), "scores": scores})
    write_plot(out / "agreement.png", scores)
    for metric, mean in means(found).items():
        text = "-" if mean is None else f"{mean:.3f}"
        console.print(f"{metric}: {text} with {partner(metric)}", highlight=False, markup=False)
    console.print(f"table, values and plot: {out}/agreement.{{md,csv,json,png}}", highlight=False, markup=False)
    return 0


def _prediction_folders(runs: Sequence[Path]) -> Iterator[Path]:
    for run in runs:
        if not run.is_dir():
            raise problem(run, "a folder of run-benchmark", "no such folder", "correct the name")
        yield from sorted(p for p in run.glob("predictions/*/*") if p.is_dir() and not p.name.startswith("."))


def _score(folder: Path, scene: Scene) -> Values:
    ids = (*dict.fromkeys(map(partner, SPIKE_METRICS)), *SPIKE_METRICS)
    values = score_scene(open_for(folder, scene), scene, select_metrics(SPIKE_METRICS).among(ids))["metrics"]
    return {metric: values[metric] for metric in ids}


def correlations(scores: Mapping[str, Mapping[str, Values]]) -> Correlations:
    """Return the rank correlation of each metric of spikes with its partner; None where too few methods have both."""
    from scipy.stats import spearmanr

    found: Correlations = {metric: {} for metric in SPIKE_METRICS}
    for metric, (scene, methods) in itertools.product(SPIKE_METRICS, scores.items()):
        sign = 1 if METRICS[metric].higher_is_better else -1
        pairs = [(sign * a, b) for a, b in _pairs(methods, metric)]
        both = [set(column) for column in zip(*pairs, strict=True)]
        enough = len(pairs) >= FEWEST and min(map(len, both)) > 1
        found[metric][scene] = float(spearmanr(pairs).statistic) if enough else None
    return found


def _pairs(methods: Mapping[str, Values], metric: str) -> list[tuple[float, float]]:
    """Return the values of a metric of spikes and of its partner, of all methods that have both."""
    values = [(v[metric], v[partner(metric)]) for v in methods.values()]
    return [(a, b) for a, b in values if a is not None and b is not None]


def means(found: Correlations) -> dict[str, float | None]:
    """Return each metric's mean correlation over the scenes that have one."""
    known = {metric: [v for v in of.values() if v is not None] for metric, of in found.items()}
    return {metric: sum(values) / len(values) if values else None for metric, values in known.items()}


def to_markdown(found: Correlations, scores: Mapping[str, Mapping[str, Values]]) -> str:
    """Return the correlations as a Markdown table: a row for each metric, a column for each scene."""
    mean = means(found)

    lines = [
        "# Rank correlation of the metrics of spikes with PSNR",
        "",
        "Spearman's, over methods; the metrics of the moving region with the PSNR of that region. 1 is the same order.",
        "",
    ]
    rows = [["methods", *(str(len(methods)) for methods in scores.values()), ""]]
    for metric, of_scenes in found.items():
        values = [*(of_scenes[scene] for scene in scores), mean[metric]]
        rows.append([f"`{metric}`", *("-" if v is None else f"{v:.3f}" for v in values)])
    lines += markdown(["metric", *scores, "mean"], rows)
    return "\n".join(lines) + "\n"


def write_plot(path: Path, scores: Mapping[str, Mapping[str, Values]]) -> None:
    """Write a PNG: each metric of spikes against its partner, a point per method, a colour per scene."""
    columns = len(SPIKE_METRICS) // 2
    figure = new_figure((3.6 * columns, 6.6))
    for ax, metric in zip(figure.subplots(2, columns).flat, SPIKE_METRICS, strict=True):
        for i, (scene, methods) in enumerate(scores.items()):
            if pairs := _pairs(methods, metric):
                values, true = zip(*pairs, strict=True)
                ax.plot(true, values, "o", color=method_color(2 * i), ms=4, alpha=0.8, label=scene)
        ax.set_xlabel(f"{METRICS[partner(metric)].title}, dB", fontsize=8)
        ax.set_title(METRICS[metric].title, fontsize=9)
        if not METRICS[metric].higher_is_better:
            ax.set_yscale("symlog", linthresh=0.01)
        ax.tick_params(labelsize=7)
        ax.grid(alpha=0.3)
    handles = {label: h for ax in figure.axes for h, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside right upper", fontsize=8)
    save_figure(figure, path)
