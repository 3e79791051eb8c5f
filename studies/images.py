"""`speed images`: time and quality of every way from spikes to images, beside the paper's Table 6.

Each maker sees the stream of the held-out camera itself, and its images of the scored ticks are compared with the
ground truth, as the benchmark compares a method's. Nothing is trained here. Where a scene has that camera's calibration
recordings, images are scored a second time, corrected by them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tyro.conf import Positional

from spike4dgs.baselines.images.table import IMAGES, ImageMaker
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.metrics.image_pair import ImagePair, check_images
from spike4dgs.benchmark.metrics.measure import mean
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.error_map import show_error, show_error_scale
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.benchmark.scene.calibration import Calibration, estimate
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.self_calibration.clocks import with_camera
from spike4dgs.method.self_calibration.shading import with_shadings
from spike4dgs.method.starts.rig import rig
from spike4dgs.method.training_views.pinholes import as_pinholes, with_lenses
from spike4dgs.studies.kit.timing import by_turns_ms, show_table
from spike4dgs.studies.speed_error.images import filled_stream, fired_stream, held_out

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Quality = Mapping[str, Mapping[str, float | None]]  # scene id -> metric id -> mean
QUALITY = ("psnr", "ssim", "psnr_dynamic")
WIDTH, HEIGHT, TICKS = 400, 250, 400  # of the stream that all are timed on
TABLE_6 = {  # of the paper, name, PSNR and SSIM: averages over its own scenes, which are not available
    "tfi": ("TFI", 24.51, 0.850),
    "tfp": ("TFP", 25.37, 0.852),
    "tfstp": ("TVS", 22.43, 0.821),
    "spk2img": ("Spike2img", 30.76, 0.904),
    "msdi": ("MSDI's images", 34.90, 0.961),
}
STANDS_IN = {"tfstp": "stands in for TVS, which the paper does not define"}


def images(
    scenes: Positional[tuple[Path, ...]] = (),
    *,
    repeats: int = 5,
    out: Path = Path("runs/images"),
    allow_gaps: bool = False,
) -> int:
    """Time every image maker, and score it at the held-out cameras of the given scenes.

    Writes the table to OUT/images.csv, and for each scene OUT/strip_SCENE.png: truth, images, errors.

    Args:
        scenes: Scene folders; without any, only time is measured.
        repeats: The median of so many images counts.
        out: Folder for the table and the strips.
        allow_gaps: Accept recordings with gaps.
    """
    opened = [open_scene(path, allow_gaps) for path in scenes]
    if repeats < 1:
        raise problem("--repeats", "1 or more", str(repeats), "correct it")
    rows = [measure_maker(name, maker, opened, repeats) for name, maker in IMAGES.items()]
    size = f"ms {opened[0].meta['width']}x{opened[0].meta['height']}" if opened else "ms, scene"
    quality = ("PSNR", "SSIM", "PSNR, moving", "PSNR, corrected", "moving, corrected")
    columns = ("images", f"ms {WIDTH}x{HEIGHT}", size, *quality, "in Table 6", "its PSNR", "its SSIM")
    title = f"Images from spikes, median ms of {repeats}, quality at the held-out cameras of {len(opened)} scene(s)"
    show_table(title, columns, [_texts(r) for r in rows], out / "images.csv", [r.note for r in rows])
    scored = [row for row in rows if row.quality]
    if len(opened) > 1:
        by_scene = [(s.id, *(METRICS["psnr"].format(row.quality[s.id]["psnr"]) for row in scored)) for s in opened]
        show_table("PSNR by scene", ("scene", *(row.name for row in scored)), by_scene, out / "images_by_scene.csv")
    for scene in opened:
        write_strip(out / f"strip_{scene.id}.png", scene, scored)
    if opened:
        print(f"images: {out}/strip_*.png")
    return 0


@dataclass(frozen=True)
class Row:
    """The measurements of an image maker. A value that does not exist is None, and `note` says why."""

    name: str
    ms: float | None = None  # an image of 400x250, median
    scene_ms: float | None = None  # an image of the first scene's size, median
    quality: Quality = field(default_factory=dict)
    corrected: Quality = field(default_factory=dict)  # of images corrected by the camera's calibration
    note: str = ""


def measure_maker(name: str, maker: ImageMaker, scenes: Sequence[Scene], repeats: int) -> Row:
    """Return the row of a maker with time and quality, or with the reason why it cannot run."""
    stream = fired_stream(TICKS, WIDTH, HEIGHT)
    try:
        ms = by_turns_ms([partial(maker, stream, [stream.n_ticks // 2], 1.0)], repeats)[0][1]
    except UserError as e:  # no weights, for example
        return Row(name, note=str(e))
    scene_ms = None
    if scenes:
        first, tick, gain = held_out(scenes[0], middle_target(scenes[0]))
        scene_ms = by_turns_ms([partial(maker, first, [tick], gain)], repeats)[0][1]
    cameras = {s.id: calibrations(s) for s in scenes}
    # A mean over some scenes tells nothing beside one over all.
    calibrated = all(len(cameras[s.id]) == len(s.test) for s in scenes)
    corrected = {s.id: score_maker(maker, s, cameras[s.id], QUALITY) for s in scenes} if calibrated else {}
    quality = {scene.id: score_maker(maker, scene, {}, QUALITY) for scene in scenes}
    return Row(name, ms, scene_ms, quality, corrected, STANDS_IN.get(name, ""))


def mean_over_scenes(quality: Quality, metric: str) -> float | None:
    """Return the mean of a metric over the scenes; None where there is none."""
    return mean([values[metric] for values in quality.values()])


def _texts(row: Row) -> tuple[str, ...]:
    ms = ("-" if v is None else f"{v:.3g}" if v < 100 else f"{v:.0f}" for v in (row.ms, row.scene_ms))
    shown = [(row.quality, metric) for metric in QUALITY] + [(row.corrected, m) for m in ("psnr", "psnr_dynamic")]
    scores = (METRICS[metric].format(mean_over_scenes(quality, metric)) for quality, metric in shown)
    if row.name not in TABLE_6:
        return (row.name, *ms, *scores, "-", "-", "-")
    name, psnr, ssim = TABLE_6[row.name]
    return (row.name, *ms, *scores, name, f"{psnr:.2f}", f"{ssim:.3f}")


def middle_target(scene: Scene) -> Target:
    """Return the scored image in the middle of the list. Raises UserError for a scene without any."""
    if not scene.targets:
        raise problem(scene.root, "a scene with targets", "none in targets.json", "use a scene that has ground truth")
    return scene.targets[len(scene.targets) // 2]


@lru_cache(maxsize=1)
def told(scene: Scene) -> dict[str, Calibration]:
    """Return what all cameras' clips tell, at the given poses, of the held-out cameras: smooth shadings, if any."""
    seen = replace(scene.training, recordings=())
    for camera in scene.test:
        seen = with_camera(seen, scene.cameras[camera], filled_stream(scene, camera), None)
    straight = as_pinholes(seen)
    start = rig(straight)
    shaded = with_shadings(seen, replace(start, cameras=with_lenses(straight, start.cameras)))
    found = {camera: shaded.state(camera).shading for camera in scene.test}
    return {c: Calibration.of_shading(s, scene.radiance_gain) for c, s in found.items() if s is not None}


def calibrations(scene: Scene) -> dict[str, Calibration]:
    """Return the calibrations of a scene's held-out cameras, of those that have recordings."""
    return {c: estimate(found) for c in scene.test if (found := scene.recordings(c))}


def score_maker(
    maker: ImageMaker, scene: Scene, cameras: Mapping[str, Calibration], metrics: Sequence[str]
) -> dict[str, float | None]:
    """Return the means over a scene's targets, of images that know their camera where it is in `cameras`.

    Raises UserError where the maker cannot run, without its weights for example.
    """
    found: dict[str, list[float | None]] = {metric: [] for metric in metrics}
    for target in scene.targets:
        image = _image(maker, *held_out(scene, target), cameras.get(target.camera))
        truth, moving, where = scene.ground_truth(target), scene.moving(target), f"{scene.id}, {target.name}"
        check_images(truth, image, moving, where)
        pair = ImagePair(truth, image, moving, where)
        for metric in metrics:
            found[metric].append(METRICS[metric].measure(pair))
    return {metric: mean([v for v in values if v is not None]) for metric, values in found.items()}


def _image(maker: ImageMaker, stream: SpikeStream, tick: int, gain: float, camera: Calibration | None) -> Float32:
    image = maker(stream, [tick], gain, camera)[0]
    return np.nan_to_num(image) if camera else image  # a dead pixel counts as black: something has to be compared


def write_strip(path: Path, scene: Scene, rows: Sequence[Row]) -> None:
    """Write a PNG of the middle target: truth and the image of each maker, error maps below."""
    target = middle_target(scene)
    truth = scene.ground_truth(target)
    width = 2.8
    size = (width * (len(rows) + 1), 2 * width * scene.meta["height"] / scene.meta["width"] + 0.7)
    figure = new_figure(size, "compressed")
    axes = figure.subplots(2, len(rows) + 1, squeeze=False)
    for ax in axes.flat:
        ax.axis("off")
    _show_image(axes[0, 0], f"truth, {scene.id}, tick {target.tick}", truth)
    for (top, below), row in zip(axes[:, 1:].T, rows, strict=True):
        image = _image(IMAGES[row.name], *held_out(scene, target), None)
        psnr = METRICS["psnr"].format(row.quality[scene.id]["psnr"])
        _show_image(top, f"{row.name}, {psnr} dB over the scene", image)
        show_error(below, image, truth)
    if rows:
        show_error_scale(axes[1, 0])
    save_figure(figure, path)


def _show_image(ax: Axes, title: str, image: Float32) -> None:
    ax.set_title(title, fontsize=8)
    ax.imshow(encode_srgb(image), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
