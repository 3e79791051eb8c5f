"""`speed images`: time and quality of every way from spikes to images, beside the paper's Table 6 and spikezoo.

Each maker sees the stream of the held-out camera itself (`rows`). Nothing is trained here. Where a scene has that
camera's calibration recordings, our images are scored a second time, corrected by them.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from spike4dgs.baselines.images.table import IMAGES, ImageMaker
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.studies.speed.other_programs import SPIKEZOO, measure_numpy, measure_spikezoo
from spike4dgs.studies.speed.rows import OURS, QUALITY, MakeImage, Row, corrected_quality, measured, timed_size
from spike4dgs.studies.speed.strip import write_strip
from spike4dgs.studies.speed.timing import show_table


@dataclass(frozen=True)
class Published:
    """A column of the paper's Table 6: averages over its own scenes, which are not available."""

    column: str
    psnr: float
    ssim: float


TABLE_6: dict[str, Published] = {
    "tfi": Published("TFI", 24.51, 0.850),
    "tfp": Published("TFP", 25.37, 0.852),
    "tfstp": Published("TVS", 22.43, 0.821),
    "spk2img": Published("Spike2img", 30.76, 0.904),
    "msdi": Published("MSDI's images", 34.90, 0.961),
}
STANDS_IN = {"tfstp": "stands in for TVS, which the paper does not define"}


def images(argv: Sequence[str] = ()) -> int:
    """Time every image maker, and score it at the held-out cameras of the given scenes.

    Writes the table to OUT/images.csv, and for each scene OUT/strip_SCENE.png: truth, images, errors.
    """
    p = argparse.ArgumentParser("spike4dgs speed images", description=images.__doc__)
    p.add_argument("scenes", nargs="*", type=Path, help="scene folders; without any, only time is measured")
    p.add_argument("--repeats", type=int, default=5, help="the median of so many images counts")
    p.add_argument("--out", type=Path, default=Path("runs/images"), help="folder for the table and the strips")
    p.add_argument("--allow-gaps", action="store_true", help="accept recordings with gaps")
    a = p.parse_args(list(argv))
    scenes = [open_scene(path, a.allow_gaps) for path in a.scenes]
    rows = measure_makers(scenes, a.repeats)
    title = f"Images from spikes, median ms of {a.repeats}, quality at the held-out cameras of {len(scenes)} scene(s)"
    show_table(title, _columns(scenes), [_texts(r) for r in rows], a.out / "images.csv", [r.note for r in rows])
    if len(scenes) > 1:
        scored = [row for row in rows if row.quality]
        by_scene = [(s.id, *(_show("psnr", row.quality[s.id]["psnr"]) for row in scored)) for s in scenes]
        columns = ("scene", *(row.title for row in scored))
        show_table("PSNR by scene", columns, by_scene, a.out / "images_by_scene.csv")
    for scene in scenes:
        makers = [(row, IMAGES[row.name]) for row in rows if row.by == OURS and row.quality]
        write_strip(a.out / f"strip_{scene.id}.png", scene, makers)
    if scenes:
        print(f"images: {a.out}/strip_*.png")
    return 0


def measure_makers(scenes: Sequence[Scene], repeats: int) -> list[Row]:
    """Return a row for each entry of IMAGES, then for other makers of the paper, TFSTP in numpy, and spikezoo's."""
    rows = []
    for name, maker in IMAGES.items():
        row = measured(Row(name, OURS, note=STANDS_IN.get(name, "")), partial(_prepare, maker), scenes, repeats)
        rows.append(replace(row, corrected=corrected_quality(maker, scenes)) if row.quality else row)
    rows += [Row(name, OURS, note="not among the image makers") for name in TABLE_6 if name not in IMAGES]
    rows.append(measure_numpy(repeats))
    return rows + [measure_spikezoo(name, scenes, repeats) for name in SPIKEZOO]


def _prepare(maker: ImageMaker, stream: SpikeStream, tick: int, gain: float) -> MakeImage:
    return lambda: maker(stream, [tick], gain)[0]


def _columns(scenes: Sequence[Scene]) -> tuple[str, ...]:
    size = f"ms {scenes[0].meta['width']}x{scenes[0].meta['height']}" if scenes else "ms, scene"
    quality = ("PSNR", "SSIM", "PSNR, moving", "PSNR, corrected", "moving, corrected")
    return ("images", f"ms {timed_size()}", size, *quality, "in Table 6", "its PSNR", "its SSIM")


def _texts(row: Row) -> tuple[str, ...]:
    paper = TABLE_6.get(row.name) if row.by == OURS else None
    printed = (paper.column, f"{paper.psnr:.2f}", f"{paper.ssim:.3f}") if paper else ("-", "-", "-")
    ms = ("-" if v is None else f"{v:.3g}" if v < 100 else f"{v:.0f}" for v in (row.ms, row.scene_ms))
    corrected = (_show(metric, row.corrected_mean(metric)) for metric in ("psnr", "psnr_dynamic"))
    return (row.title, *ms, *(_show(metric, row.mean(metric)) for metric in QUALITY), *corrected, *printed)


def _show(metric: str, value: float | None) -> str:
    return METRICS[metric].format(value)
