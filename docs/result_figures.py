"""Write figures of the results pages that no command writes: `python docs/result_figures.py FIGURE PATHS`.

images STRIP OUT: of strip_SCENE.png of `speed images`. sensor SCENE OUT. conditions, modality and uncalibrated OUT: of
the records. sheets SWEEP SCENES FOLDER, hard SWEEP SCENES OUT: of the predictions of `report results` on the scenes.
covisible SCENE SCENE OUT: of a scene with all its cameras and of one with three.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from spike4dgs.benchmark import open_scene
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.method import make_budget
from spike4dgs.benchmark.metrics.covisible import covisible as find_covisible
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.metrics.measure import measure
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.figure import method_color, new_figure, save_figure
from spike4dgs.benchmark.reports.panels import crops, make_panels
from spike4dgs.benchmark.reports.sheet import make_sheet
from spike4dgs.benchmark.scene.images import encode_srgb, read_exr
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.benchmark.scene.splits import DEFAULT_SPLIT, Target
from spike4dgs.studies.results.blocks import NINE, of_group
from spike4dgs.studies.results.comparison import RANKED_BY, rows_of
from spike4dgs.studies.results.plan import CEILING, TABLE1, UNPOSED, Group, once
from spike4dgs.studies.results.records import Record, read_records
from spike4dgs.studies.results.tables import conditions as on_conditions
from spike4dgs.studies.results.tables.breaks import LEVELS, NAMED, amount_text
from spike4dgs.studies.results.tables.ceilings import ceiling_row
from spike4dgs.studies.results.tables.conditions import NONE, Condition, rows_under
from spike4dgs.studies.results.tables.modality import plot_modality
from spike4dgs.studies.results.tables.published import given_row

RECORDS = Path(__file__).parent.parent / "studies" / "results" / "records"
SHOWN = (  # rows of a sheet: ours, the best tuned rival, and each kind of the paper's rows
    "spike4dgs-x",
    "spike4dgs",
    "tfp+rig-flat+stg.tuned",
    "spike4dgs-x+self-calibrated",
    "spk2img+stg",
    "tfp+4dgs",
    "tfi+4dgs",
    "tfp+d3dgs",
    "dy-spikenerf",
)
COLUMNS = 8  # of the strip: truth and seven image makers
TFP_TICKS = 40
MEASURED = {"psnr": "PSNR, dB", RANKED_BY: "PSNR where things move, dB"}
SHOWN_CONDITIONS = ("light 1/16", "four times as fast", "5 of 8 cameras")
SHEET_WIDTH = 1500  # pixels
QUICK = make_budget("quick").label


@cache
def measured() -> list[Record]:
    """Return all records."""
    return list(read_records(RECORDS).values())


def images(strip: Path, out: Path) -> None:
    """Fold the strip of `speed images` into two rows."""
    whole = Image.open(strip).convert("RGB")
    half = whole.width * 4 // COLUMNS
    folded = Image.new("RGB", (half, 2 * whole.height), "white")
    for row in range(2):
        folded.paste(whole.crop((row * half, 0, (row + 1) * half, whole.height)), (0, row * whole.height))
    folded.save(out, quality=80, method=6)


def sensor(folder: Path, out: Path) -> None:
    """Show what one simulated camera gives: a tick, the mean of 40 ticks, and its calibrated gain and dark maps."""
    scene = open_scene(folder).training
    stream, tick = scene.streams[0], scene.n_ticks // 2
    maps = (scene.calibrations or (None,))[0]
    assert maps is not None, "a scene with calibration recordings"
    counts = stream.counts(tick - TFP_TICKS // 2, tick + TFP_TICKS // 2) / TFP_TICKS
    panels = (
        ("spikes of one tick", stream.window(tick, tick + 1)[0], 0, 1, "gray"),
        (f"mean of {TFP_TICKS} ticks, spikes per tick", counts, 0, 0.6, "gray"),
        ("gain map", maps.gain, 0.85, 1.15, "coolwarm"),
        ("dark map, spikes per tick", maps.dark, 0, 0.015, "magma"),
    )
    figure = new_figure((9, 5.6), "constrained")
    for axes, (title, values, low, high, colors) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        shown = axes.imshow(values, cmap=colors, vmin=low, vmax=high, interpolation="nearest")
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
        figure.colorbar(shown, ax=axes, shrink=0.8)
    _save(figure, out)


def uncalibrated(out: Path) -> None:
    """Show each row's PSNR where things move with given and with estimated poses, from the records."""
    one_seed = replace(TABLE1, rows=once(row.name for row in TABLE1.rows))  # as those with estimated poses
    given, estimated = (_moving(group) for group in (one_seed, UNPOSED))
    colmap = {given_row(name): value for name, value in estimated.items() if "+colmap" in name}
    rows = [(name, value, given[name]) for name, value in colmap.items() if name in given]
    figure = new_figure((8, 4), "constrained")
    axes = figure.subplots()
    for y, (_, value, known) in enumerate(reversed(rows)):
        axes.plot([known, value], [y, y], color="0.6", zorder=1)
        axes.scatter([known], [y], color="tab:blue", label="given poses" if y == 0 else None)
        axes.scatter([value], [y], color="tab:orange", label="poses by COLMAP" if y == 0 else None)
    axes.set_yticks(range(len(rows)), [name for name, _, _ in reversed(rows)])
    axes.set_xlabel("PSNR where things move, dB: mean of five scenes")
    axes.grid(axis="x", alpha=0.3)
    axes.legend()
    _save(figure, out)


def modality(out: Path) -> None:
    """Show PSNR where things move against bits per second, from the records."""
    png = out.with_suffix(".png")
    plot_modality(png, measured())
    _as_webp(png, out)


def conditions(out: Path) -> None:
    """Show PSNR, whole and where things move, by light, speed, length of the clip and number of cameras, row by row.

    The change that a condition makes in one world alone is added to the mean of both.
    """
    records = measured()
    figure = new_figure((13, 8), "constrained")
    panels = figure.subplots(len(MEASURED), len(LEVELS), sharex="col", sharey="row")
    for line, (metric, title) in zip(panels, MEASURED.items(), strict=True):
        for axes, (label, levels) in zip(line, LEVELS.items(), strict=True):
            for k, planned in enumerate(on_conditions.GROUP.rows):
                curve = _curve(planned.name, metric, levels, records)
                axes.plot(*curve, "o-", color=method_color(k), label=planned.name)
            axes.plot(*_curve(CEILING, metric, levels, records), "k--", lw=0.8, label="noise of the truth")
            axes.set_xscale("log")
            axes.set_xticks(list(levels), [amount_text(x) for x in levels])
            axes.minorticks_off()
            axes.set_xlabel(label)
            axes.grid(alpha=0.3)
        line[0].set_ylabel(title)
    panels[0, 0].legend(fontsize=8)
    _save(figure, out)


def _curve(
    name: str, metric: str, levels: Mapping[float, str], records: Sequence[Record]
) -> tuple[list[float], list[float]]:
    """Return the amounts at which a row was measured, and its values there, dB."""

    def mean(condition: Condition) -> float | None:
        if name == CEILING:
            return ceiling_row(condition.scenes, records).mean(metric)
        (row,) = rows_under([name], condition, records)
        return row.mean(metric) if row.is_complete else None

    found = {}
    for amount, level in levels.items():
        condition = NAMED[level]
        values = [mean(c) for c in (condition, condition.absent, NONE)]
        if None not in values:
            there, without, both = values
            found[amount] = both + there - without
    return list(found), list(found.values())


def hard(sweep: Path, scenes: Path, out: Path) -> None:
    """Show a crop of what is hard: truth, and what each row renders at the middle of the clip, with its PSNR there."""
    names = [row.name for row in on_conditions.GROUP.rows]
    lines = [(name.partition("-")[0], name, DEFAULT_SPLIT) for name in on_conditions.CONTENT.scenes]
    lines += [(f"car, {name}", NAMED[name].scenes[0], NAMED[name].split) for name in SHOWN_CONDITIONS]
    figure = new_figure((1.9 * (len(names) + 1), 1.35 * len(lines)), "constrained")
    for axes, (title, name, split) in zip(figure.subplots(len(lines), len(names) + 1), lines, strict=True):
        scene = open_scene(scenes / name)
        target = scene.targets[len(scene.targets) // 2]
        (box,) = crops([scene.moving(target)])
        assert box is not None, "something that moves"
        shown = {title: scene.ground_truth(target)}
        for row in names:
            if folder := _predictions(sweep, row, name, split):
                image, scores = _scored(scene, target, folder)
                shown[f"{row}: {scores[RANKED_BY]:.1f} dB"] = image
        for axis in axes:
            axis.set_axis_off()
        for axis, (title, image) in zip(axes, shown.items(), strict=False):
            axis.set_title(title, fontsize=7)
            axis.imshow(encode_srgb(box.of(image)), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    _save(figure, out, SHEET_WIDTH)


def covisible(every: Path, three: Path, out: Path) -> None:
    """Mark the pixels that `psnr_covisible` leaves out, in a scene with all cameras and in one with three."""
    figure = new_figure((8, 2.8), "constrained")
    for axis, (folder, split) in zip(figure.subplots(1, 2), ((every, DEFAULT_SPLIT), (three, "views-3")), strict=True):
        scene = open_scene(folder, split=split)
        target = scene.targets[len(scene.targets) // 2]
        shown = np.repeat(encode_srgb(scene.ground_truth(target))[..., None], 3, axis=-1)
        shown[~(find_covisible(scene)[target.camera] | scene.moving(target))] = 220, 40, 30
        axis.set_axis_off()
        axis.set_title(f"{scene.id.partition('-small')[0]}, {len(scene.train)} training cameras", fontsize=8)
        axis.imshow(shown, interpolation="nearest")
    _save(figure, out, SHEET_WIDTH)


def _moving(group: Group) -> dict[str, float]:
    own = of_group(group, measured())
    rows = rows_of([row.name for row in group.rows], group.scenes, own)
    return {row.name: value for row in rows if (value := row.mean(RANKED_BY)) is not None}


def sheets(sweep: Path, scenes: Path, out: Path) -> None:
    """Write a sheet of each of the nine scenes: truth, and what the sweep's fits with seed 0 render."""
    for name in NINE.scenes:
        scene = open_scene(scenes / name)
        found = {row: _predictions(sweep, row, name) for row in SHOWN}
        folders = {row: folder for row, folder in found.items() if folder}
        records = [_record(row, scene, folder) for row, folder in folders.items()]
        _save(make_sheet(make_panels(scene, folders, records)), out / f"{name.partition('-')[0]}.webp", SHEET_WIDTH)


def _predictions(sweep: Path, row: str, scene: str, split: str = DEFAULT_SPLIT) -> Path | None:
    """Return the predictions of a row's record with seed 0, which are in the folder of the code that made it."""
    for r in measured():
        if (r["row"], r["scene"], r["split"], r["budget"], r["seed"]) == (row, scene, split, QUICK, 0):
            folder = sweep / r["code"] / f"quick-{split}" / "seed-0" / "predictions" / row / scene
            return folder if folder.is_dir() else None
    return None


def _record(row: str, scene: Scene, folder: Path) -> dict[str, Any]:
    """Return what a sheet shows of a record: PSNR of each image."""
    scores = {target.name: _scored(scene, target, folder)[1] for target in scene.targets}
    return {"method": {"name": row}, "scenes": {scene.id: {"status": "ok", "per_image": scores}}}


def _scored(scene: Scene, target: Target, folder: Path) -> tuple[Float32, dict[str, float]]:
    """Return a rendered image [H, W] and its PSNR, whole and where things move."""
    truth = scene.ground_truth(target)
    image = read_exr(folder / f"{target.name}.exr", truth.shape)
    pair = ImagePair(image, truth, scene.moving(target), target.name)
    return image, measure(pair, None, [METRICS[m] for m in ("psnr", RANKED_BY)]).values


def _save(figure: object, out: Path, width: int | None = None) -> None:
    png = out.with_suffix(".png")
    save_figure(figure, png)  # type: ignore[arg-type]
    _as_webp(png, out, width)


def _as_webp(png: Path, out: Path, width: int | None = None) -> None:
    image = Image.open(png).convert("RGB")
    if width is not None:
        image = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
    image.save(out, quality=85 if width is None else 75, method=6)
    png.unlink()


FIGURES = {
    "conditions": conditions,
    "covisible": covisible,
    "hard": hard,
    "images": images,
    "modality": modality,
    "sensor": sensor,
    "sheets": sheets,
    "uncalibrated": uncalibrated,
}

if __name__ == "__main__":
    FIGURES[sys.argv[1]](*map(Path, sys.argv[2:]))
