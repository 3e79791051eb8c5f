"""Tables of `spike4dgs-x` alone: the nine scenes, with a calibration and without, and its parts switched off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from spike4dgs.studies.kit.timing import markdown
from spike4dgs.studies.results.blocks import NINE, NOTHING, both_text, metric_text, of_group, provenance
from spike4dgs.studies.results.changes import change_text, legend_of
from spike4dgs.studies.results.comparison import rows_of
from spike4dgs.studies.results.plan import X_TRIALS, Group, Row
from spike4dgs.studies.results.records import Record

DEVELOPMENT = ("van-10-small", "motor-10-small", "turntable-10-small")
WHOLE, SELF_CALIBRATED = "spike4dgs-x", "spike4dgs-x+self-calibrated"
SWITCHES = {  # what is switched off -> the settings that do it
    "calibration": "images.flat_field=false,initialization.flat_field=false,initialization.noise=0.0004",
    "points from images with hardly any noise": "initialization.noise=0.0004",
    "a narrow start": "trainer.initial_scale=1",
    "the pixel's own filter": "trainer.filter_variance=0.3,trainer.filter_compensated=false",
    "short spans (at most 20 ticks, not 12)": "image_maker.half=10",
    "rates for short fits": ",".join(
        f"trainer.lr_{name}" for name in ("scales=0.005", "quats=0.001", "opacities=0.05", "colors=0.0025")
    ),
    "betas for short fits": "trainer.beta1=0.9,trainer.beta2=0.99",
    "the mean of the last steps": "trainer.average=0",
    "a frozen background": "trainer.freeze_background=false",
    "the cap on what moves": "density.max_moving_per_pixel=4",
    "coherence of motion": "motion.coherence=0",
    "Huber's loss": "supervision.huber_delta=0",
    "SSIM in the loss": "supervision.ssim_weight=0",
}
GROUP = Group(
    "parts",
    "Parts of spike4dgs-x",
    DEVELOPMENT,
    tuple(Row(name, 1, X_TRIALS, ours=True) for name in (WHOLE, *(f"{WHOLE}[{s}]" for s in SWITCHES.values()))),
)
_OWN = replace(NINE, rows=tuple(row for row in NINE.rows if row.name == WHOLE))
_METRICS = {  # heads of columns -> metric, digits
    "PSNR": ("psnr", 2),
    "SSIM": ("ssim", 4),
    "PSNR, moving": ("psnr_dynamic", 2),
    "SSIM, moving": ("ssim_dynamic", 4),
    "FLIP": ("flip", 3),
    "temporal error": ("temporal_error", 4),
}


def own_scenes_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of a table of the nine scenes, and of their mean: what `spike4dgs-x` reaches on each."""
    own = of_group(_OWN, records)
    if not own:
        return [NOTHING]
    lines = []
    for scenes in (*((scene,) for scene in NINE.scenes), NINE.scenes):
        (row,) = rows_of([WHOLE], scenes, own)
        texts = [metric_text(row.mean(metric), digits) for metric, digits in _METRICS.values()]
        lines.append(["**mean**" if len(scenes) > 1 else scenes[0].partition("-")[0], *texts])
    return [*markdown(("scene", *_METRICS), lines), "", f"`{WHOLE}`, means over seeds.", "", provenance(own, _OWN)]


def self_calibrated_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of a table of the nine scenes, and of their mean: what the missing flat fields cost."""
    names = (WHOLE, SELF_CALIBRATED)
    group = replace(NINE, rows=tuple(row for row in NINE.rows if row.name in names))
    own = of_group(group, records)
    if {r["row"] for r in own} != {*names}:
        return [NOTHING]
    lines = []
    for scenes in (*((scene,) for scene in NINE.scenes), NINE.scenes):
        given, without = rows_of(names, scenes, own)
        title = "**mean**" if len(scenes) > 1 else scenes[0].partition("-")[0]
        lines.append([title, both_text(given), both_text(without), change_text(without, given)])
    legend = "PSNR of the whole image / where things move, dB; means over seeds."
    table = markdown(("scene", *(f"`{name}`" for name in names), "change"), lines)
    return [*table, "", legend_of(legend, lines), "", provenance(own, group)]


def parts_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of the table: PSNR of the whole recipe, and what each part's absence changes, in dB."""
    own = of_group(GROUP, records)
    if not any(r["row"] == WHOLE for r in own):
        return [NOTHING]
    names = [row.name for row in GROUP.rows]
    columns = []
    for scenes in (*((scene,) for scene in GROUP.scenes), GROUP.scenes):
        whole, *without = rows_of(names, scenes, own)
        columns.append([both_text(whole), *(change_text(row, whole) for row in without)])
    firsts = [("nothing", ""), *((part, ", ".join(f"`{s}`" for s in by.split(","))) for part, by in SWITCHES.items())]
    lines = [[*first, *texts] for first, *texts in zip(firsts, *columns, strict=True)]
    heads = ("switched off", "by", *(f"`{scene}`" for scene in GROUP.scenes), "mean")
    legend = f"`{WHOLE}`: whole image / where things move, dB. The first row lists PSNR, the others its change."
    return [*markdown(heads, lines), "", legend_of(legend, lines), "", provenance(own, GROUP)]
