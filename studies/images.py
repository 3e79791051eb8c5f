"""`speed images`: time and quality of every way from spikes to images, beside the paper's Table 6 and spikezoo.

Each maker sees the stream of the held-out camera itself, and its images of the scored ticks are compared with the
ground truth, as the benchmark compares a method's. Nothing is trained here. Where a scene has that camera's calibration
recordings, our images are scored a second time, corrected by them.

spikezoo gets its window of 41 ticks, centred on the middle of the tick, as a ready-made float array: taking the window
out of the stream does not count. numpy gets an unpacked clip likewise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from tyro.conf import Positional

from spike4dgs.baselines.images.table import IMAGES, ImageMaker
from spike4dgs.baselines.images.tfstp import TfstpSettings, tfstp_image
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.metrics.image_pair import ImagePair, check_images
from spike4dgs.benchmark.metrics.measure import mean
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.error_map import show_error, show_error_scale
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.benchmark.scene.calibration import estimate
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.studies.kit.timing import by_turns_ms, module_of, show_table
from spike4dgs.studies.speed_error.images import fired_stream, held_out

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MakeImage = Callable[[], Float32]  # makes one image, [H, W] linear radiance
Prepare = Callable[[SpikeStream, int, float], MakeImage]  # stream, tick, gain: all that comes before the clock starts
Quality = Mapping[str, Mapping[str, float | None]]  # scene id -> metric id -> mean
QUALITY = ("psnr", "ssim", "psnr_dynamic")
OURS = "spike4dgs"
WIDTH, HEIGHT, TICKS = 400, 250, 400  # of the stream that all are timed on


SPIKEZOO = {  # ours -> its folder and class
    "tfi": ("tfi", "TFIModel"),
    "tfp": ("tfp", "TFPModel"),
    "tfstp": ("tfstp", "TFSTP"),
    "spk2img": ("spk2imgnet", "SpikeNet"),
}
UNTRAINED = {"spk2img": "no weights in the package: only its time counts"}
_WINDOW = 41  # ticks that spikezoo's models see


TABLE_6 = {  # of the paper, name, PSNR and SSIM: averages over its own scenes, which are not available
    "tfi": ("TFI", "24.51", "0.850"),
    "tfp": ("TFP", "25.37", "0.852"),
    "tfstp": ("TVS", "22.43", "0.821"),
    "spk2img": ("Spike2img", "30.76", "0.904"),
    "msdi": ("MSDI's images", "34.90", "0.961"),
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
    rows = measure_makers(opened, repeats)
    title = f"Images from spikes, median ms of {repeats}, quality at the held-out cameras of {len(opened)} scene(s)"
    show_table(title, _columns(opened), [_texts(r) for r in rows], out / "images.csv", [r.note for r in rows])
    if len(opened) > 1:
        scored = [row for row in rows if row.quality]
        by_scene = [(s.id, *(_show("psnr", row.quality[s.id]["psnr"]) for row in scored)) for s in opened]
        columns = ("scene", *(row.title for row in scored))
        show_table("PSNR by scene", columns, by_scene, out / "images_by_scene.csv")
    for scene in opened:
        makers = [(row, IMAGES[row.name]) for row in rows if row.by == OURS and row.quality]
        write_strip(out / f"strip_{scene.id}.png", scene, makers)
    if opened:
        print(f"images: {out}/strip_*.png")
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
    return ("images", f"ms {WIDTH}x{HEIGHT}", size, *quality, "in Table 6", "its PSNR", "its SSIM")


def _texts(row: Row) -> tuple[str, ...]:
    printed = TABLE_6.get(row.name if row.by == OURS else "", ("-", "-", "-"))
    ms = ("-" if v is None else f"{v:.3g}" if v < 100 else f"{v:.0f}" for v in (row.ms, row.scene_ms))
    corrected = (_show(metric, row.corrected_mean(metric)) for metric in ("psnr", "psnr_dynamic"))
    return (row.title, *ms, *(_show(metric, row.mean(metric)) for metric in QUALITY), *corrected, *printed)


def _show(metric: str, value: float | None) -> str:
    return METRICS[metric].format(value)


@dataclass(frozen=True)
class Row:
    """The measurements of one image maker. A value that does not exist is None, and `note` says why."""

    name: str  # the entry of IMAGES, or ours that it corresponds to
    by: str
    ms: float | None = None  # an image of 400x250, median
    scene_ms: float | None = None  # an image of the first scene's size, median
    quality: Quality = field(default_factory=dict)
    corrected: Quality = field(default_factory=dict)  # of images corrected by the camera's calibration
    note: str = ""

    @property
    def title(self) -> str:
        """The name, and by whom if not by us."""
        return self.name if self.by == OURS else f"{self.name}, {self.by}"

    def mean(self, metric: str) -> float | None:
        """Return the mean over the scenes of a metric; None where there is none."""
        return mean([values[metric] for values in self.quality.values()])

    def corrected_mean(self, metric: str) -> float | None:
        """Return the same of corrected images."""
        return mean([values[metric] for values in self.corrected.values()])


def measured(row: Row, prepare: Prepare, scenes: Sequence[Scene], repeats: int, scored: bool = True) -> Row:
    """Return the row with time and quality, or with the reason where the maker cannot run."""
    stream = fired_stream(TICKS, WIDTH, HEIGHT)
    try:
        ms = by_turns_ms([prepare(stream, stream.n_ticks // 2, 1.0)], repeats)[0][1]
    except UserError as e:  # no weights, for example
        return replace(row, note=str(e))
    scene_ms = by_turns_ms([prepare(*held_out(scenes[0], middle_target(scenes[0])))], repeats)[0][1] if scenes else None

    def make(scene: Scene, target: Target) -> Float32:
        return prepare(*held_out(scene, target))()

    quality = {scene.id: _score(make, scene) for scene in scenes} if scored else {}
    return replace(row, ms=ms, scene_ms=scene_ms, quality=quality)


def corrected_quality(maker: ImageMaker, scenes: Sequence[Scene]) -> Quality:
    """Return the scores of images that know their camera, on scenes with recordings to calibrate it by."""
    known = [s for s in scenes if all(s.recordings(c) for c in s.test)]
    cameras = {(s.id, c): estimate(r) for s in known for c in s.test if (r := s.recordings(c))}

    def make(scene: Scene, target: Target) -> Float32:
        stream, tick, gain = held_out(scene, target)
        image = maker(stream, [tick], gain, cameras[scene.id, target.camera])[0]
        return np.nan_to_num(image)  # a dead pixel counts as black: something has to be compared

    return {scene.id: _score(make, scene) for scene in known}


def middle_target(scene: Scene) -> Target:
    """Return the scored image in the middle of the list. Raises UserError for a scene without any."""
    if not scene.targets:
        raise problem(scene.root, "a scene with targets", "none in targets.json", "use a scene that has ground truth")
    return scene.targets[len(scene.targets) // 2]


def _score(make: Callable[[Scene, Target], Float32], scene: Scene) -> dict[str, float | None]:
    """Return the means over a scene's targets."""
    found: dict[str, list[float | None]] = {metric: [] for metric in QUALITY}
    for target in scene.targets:
        image, truth, moving = make(scene, target), scene.ground_truth(target), scene.moving(target)
        where = f"{scene.id}, {target.name}"
        check_images(truth, image, moving, where)
        pair = ImagePair(truth, image, moving, where)
        for metric in QUALITY:
            found[metric].append(METRICS[metric].measure(pair))
    return {metric: mean([v for v in values if v is not None]) for metric, values in found.items()}


def measure_numpy(repeats: int) -> Row:
    """Return the row of TFSTP in plain numpy, with the difference to ours in its note."""
    stream = fired_stream(TICKS, WIDTH, HEIGHT)
    tick = stream.n_ticks // 2
    spikes = stream.window(0, stream.n_ticks).astype(bool)
    plain = tfstp_plainly(spikes, tick)
    error = float(np.nanmax(np.abs(plain - tfstp_image(stream, tick))))
    ms = by_turns_ms([lambda: tfstp_plainly(spikes, tick)], repeats)[0][1]
    return Row("tfstp", "numpy", ms, note=f"whole history, float64; {OURS} is within {error:.0e} spikes per tick")


def tfstp_plainly(spikes: NDArray[np.bool_], tick: int) -> NDArray[np.float64]:
    """Return TFSTP from the published equations, all pixels of [T, H, W] at once.

    It is NaN where no interval contains `tick`.
    """
    s = TfstpSettings()
    last = np.full(spikes.shape[1:], -1)
    u, q = np.full(last.shape, s.u0), np.zeros(last.shape)  # q = 1 - R, which float64 could not hold as R
    done = np.zeros(last.shape, bool)
    for t, fired in enumerate(spikes):
        now = fired & ~done & (last >= 0)
        gap, u_now, q_now = (t - last)[now], u[now], q[now]
        q[now] = (q_now + u_now - q_now * u_now) * np.exp(-gap / s.d_ticks)
        u[now] = s.u0 + (u_now + s.jump * (1 - u_now) - s.u0) * np.exp(-gap / s.f_ticks)
        last[fired] = t
        done |= now & (t >= tick)
        if done.all():
            break
    with np.errstate(divide="ignore", invalid="ignore"):
        interval_r = -s.d_ticks * np.log(q / (q + u - q * u))
        interval_u = -s.f_ticks * np.log((u - s.u0) / (s.jump - s.u0 + u * (1 - s.jump)))
        return np.where(done, (1 / interval_r + 1 / interval_u) / 2, np.nan)


def measure_spikezoo(name: str, scenes: Sequence[Scene], repeats: int) -> Row:
    """Return the row of spikezoo's model, which may lack packages, ask for a device that is not there, or fail."""
    folder, model = SPIKEZOO[name]
    row = Row(name, "spikezoo", note=UNTRAINED.get(name, ""))
    try:
        if (module := module_of("spikezoo", f"archs/{folder}/nets.py")) is None:
            return replace(row, note="not installed")
        net = getattr(module, model)().eval()
        return measured(row, partial(_prepare_spikezoo, net), scenes, repeats, scored=name not in UNTRAINED)
    except Exception as e:  # somebody else's package
        return replace(row, note=f"does not run here: {type(e).__name__}: {e}")


def _prepare_spikezoo(net: Any, stream: SpikeStream, tick: int, gain: float) -> MakeImage:
    """Return a run of a spikezoo model on the 41 ticks around `tick`, or the nearest ones that the clip has."""
    start = max(0, min(tick - _WINDOW // 2, stream.n_ticks - _WINDOW))
    spikes = torch.from_numpy(stream.window(start, start + _WINDOW)).float()[None]  # [1, T, H, W]
    spikes = torch.nn.functional.pad(spikes, (0, -stream.width % 4, 0, -stream.height % 4), mode="replicate")

    def make() -> Float32:
        with torch.no_grad():
            image = net(spikes)[0, 0, : stream.height, : stream.width].numpy()
        return np.asarray(image / gain, np.float32)

    return make


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
    _show_image(axes[0, 0], f"truth, {scene.id}, tick {target.tick}", truth)
    for (top, below), (row, maker) in zip(axes[:, 1:].T, makers, strict=True):
        stream, tick, gain = held_out(scene, target)
        image = maker(stream, [tick], gain)[0]
        psnr = METRICS["psnr"].format(row.quality[scene.id]["psnr"])
        _show_image(top, f"{row.name}, {psnr} dB over the scene", image)
        show_error(below, image, truth)
    if makers:
        show_error_scale(axes[1, 0])
    save_figure(figure, path)


def _show_image(ax: Axes, title: str, image: Float32) -> None:
    ax.set_title(title, fontsize=8)
    ax.imshow(encode_srgb(image), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
