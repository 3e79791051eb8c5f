"""Table 6 of the paper: every image maker on the held-out cameras' own spikes. Nothing is fitted.

Rows are MAKER.images, MAKER+shading.images where the shading that the array's clips tell corrects the images, and
MAKER+rig-flat.images where the camera's calibration does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

from spike4dgs.baselines.images.published.makers import MAKERS as PUBLISHED
from spike4dgs.baselines.images.table import IMAGES, ImageMaker
from spike4dgs.benchmark.reports.paper_tables import tau_of
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.benchmark.weights import WeightsError
from spike4dgs.studies.images import TABLE_6, calibrations, middle_target, score_maker, told
from spike4dgs.studies.kit.timing import by_turns_ms, markdown
from spike4dgs.studies.results.blocks import NOTHING, both_text, of_group, provenance
from spike4dgs.studies.results.comparison import MeasuredRow, rows_of
from spike4dgs.studies.results.plan import CALIBRATED, NOT_TUNED, OUR_TRIALS, TABLE1, TABLE2, UNCALIBRATED, Group, Row
from spike4dgs.studies.results.records import COSTS, Record, short
from spike4dgs.studies.speed_error.images import held_out

SUFFIX, CORRECTED, SHADED = ".images", "+rig-flat", "+shading"
_CAMERAS: Mapping[str, Callable[[Scene], dict[str, Calibration]]] = {  # of held-out cameras, what a row knows
    "": lambda scene: {},
    SHADED: told,
    CORRECTED: calibrations,
}
_METRICS = ("psnr", "ssim", "psnr_dynamic", "ssim_dynamic", "flip")
_REPEATS = 5  # the median of so many images is the time
_TUNED_ON = {
    **dict.fromkeys(("adaptive", "intervals", "msdi"), OUR_TRIALS),
    **dict.fromkeys((maker.name for maker in PUBLISHED), "three variants 10 at tiny, for the scale of their output"),
}


def _row(maker: str, knows: str) -> Row:
    return Row(f"{maker}{knows}{SUFFIX}", 1, _TUNED_ON.get(maker, NOT_TUNED))


TABLE6 = Group(
    "table6",
    "Table 6: images from spikes",
    (*TABLE1.scenes, *TABLE2.scenes),
    tuple(_row(maker, knows) for maker in IMAGES for knows in _CAMERAS),
)


def maker_of(row: str) -> ImageMaker:
    """Return the image maker of a row."""
    return IMAGES[row.removesuffix(SUFFIX).removesuffix(_known(row))]


def _known(row: str) -> str:
    return next((knows for knows in (SHADED, CORRECTED) if row.endswith(f"{knows}{SUFFIX}")), "")


def measure_images(row: str, scene: Scene) -> Record:
    """Return the part of a record that the images of a row tell: knowledge, metrics, images per second."""
    maker, knows = maker_of(row), _known(row)
    knowledge = CALIBRATED if knows == CORRECTED else UNCALIBRATED
    part: Record = {"knowledge": knowledge, "metrics": {}, **dict.fromkeys(COSTS)}
    cameras = _CAMERAS[knows](scene)
    if knows and len(cameras) < len(scene.test):
        lacking = "no calibration recordings" if knows == CORRECTED else "the clips tell no shading"
        return {**part, "error": f"skipped: {lacking} of a held-out camera"}
    try:
        scores = score_maker(maker, scene, cameras, _METRICS)
    except WeightsError as e:
        return {**part, "error": f"skipped: {e.reason}"}
    stream, tick, gain = held_out(scene, middle_target(scene))
    ms = by_turns_ms([partial(maker, stream, [tick], gain)], _REPEATS)[0][1]
    metrics = {name: short(value) for name, value in scores.items() if value is not None}
    return {**part, "metrics": metrics, "render_fps": short(1000 / ms), "error": None}


def images_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of table 6: each maker's images as they are and corrected, best first, and the paper's."""
    own = of_group(TABLE6, records)
    known = {row.name: row for row in rows_of([row.name for row in TABLE6.rows], TABLE6.scenes, own)}
    rows = {maker: tuple(known[f"{maker}{knows}{SUFFIX}"] for knows in _CAMERAS) for maker in IMAGES}
    measured = [maker for maker, (plain, *_) in rows.items() if plain.is_complete]
    if not measured:
        return [NOTHING]
    measured.sort(key=lambda maker: -(rows[maker][0].mean("psnr") or 0.0))
    lines = [
        [f"`{maker}`", _ms(rows[maker][0]), *(s for row in rows[maker] for s in _scores(row)), *_printed(maker)]
        for maker in measured
    ]
    scores = ("PSNR / moving", "SSIM", "shading: PSNR / moving", "SSIM", "corrected: PSNR / moving", "SSIM")
    heads = ("images", "ms", *scores, "in table 6", "published PSNR / SSIM")
    legend = (
        f"Means of {len(TABLE6.scenes)} scenes; milliseconds for an image of 200x125, in parentheses where other "
        "programs ran. Shading: corrected by the smooth shading estimated from the array's clips at the given poses. "
        "Corrected images know the camera's flat field and dark recording."
    )
    text = _agreement({maker: rows[maker][0] for maker in measured}) + legend
    return [*markdown(heads, lines), "", text, "", provenance(own, TABLE6)]


def _agreement(rows: dict[str, MeasuredRow]) -> str:
    tau = tau_of((row.mean("psnr"), TABLE_6[maker][1]) for maker, row in rows.items() if maker in TABLE_6)
    return "" if tau is None else f"Kendall's tau with the published order of PSNR: {tau:.2f}. "


def _scores(row: MeasuredRow) -> list[str]:
    return [both_text(row), f"{row.mean('ssim'):.4f}" if row.is_complete else "-"]


def _ms(row: MeasuredRow) -> str:
    times = [1000 / fps for r in row.cells.values() if (fps := r["render_fps"])]
    ms = sum(times) / max(len(times), 1)
    text = "-" if not times else f"{ms:.2g}" if ms < 10 else f"{ms:.0f}"
    return text if row.is_quiet else f"({text})"


def _printed(maker: str) -> list[str]:
    if maker not in TABLE_6:
        return ["", ""]
    name, psnr, ssim = TABLE_6[maker]
    return [name, f"{psnr:.2f} / {ssim:.3f}"]
