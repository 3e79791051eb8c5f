"""`speed images`: time and quality of every way from spikes to images, beside the paper's Table 6 and spikezoo.

Quality is measured at the scenes' held-out cameras: each generator sees the held-out stream itself, and its images of
the scored ticks are compared with the ground truth, as the benchmark compares a method's. Nothing is trained here.
Where a scene has that camera's calibration recordings, ours are scored a second time, corrected by them.

spikezoo gets its window of 41 ticks as a ready-made float array, centred on the middle of the tick: taking the window
out of the stream does not count for it, and its images are half a tick late. numpy gets an unpacked clip likewise.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.baselines.speed import fired_stream
from spike4dgs.baselines.spike_to_image.table import IMAGES, ImageMaker
from spike4dgs.baselines.spike_to_image.tfstp import D_TICKS, F_TICKS, JUMP, U0, tfstp_image
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.metrics.image_pair import ImagePair, check_images
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.scene.calibration import estimate
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.benchmark.speed.timing import module_of, show_table, time_ms
from spike4dgs.benchmark.spikes.stream import SpikeStream

Float32 = NDArray[np.float32]
Draw = Callable[[], Float32]  # makes one image, [H, W] linear radiance
Prepare = Callable[[SpikeStream, int, float], Draw]  # stream, tick, gain: what comes before the clock starts
Quality = Mapping[str, Mapping[str, float | None]]  # scene id -> metric id -> mean
QUALITY = ("psnr", "ssim", "psnr_dynamic")
WIDTH, HEIGHT, TICKS = 400, 250, 400  # of the stream that all are timed on
OURS = "spike4dgs"
_WINDOW = 41  # ticks that spikezoo's models see
_ERROR_MAX = 0.3  # the error maps' white


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
SPIKEZOO = {  # ours -> its folder and class
    "tfi": ("tfi", "TFIModel"),
    "tfp": ("tfp", "TFPModel"),
    "tfstp": ("tfstp", "TFSTP"),
    "spk2img": ("spk2imgnet", "SpikeNet"),
}
UNTRAINED = {"spk2img": "no weights in the package: only its time counts"}


@dataclass(frozen=True)
class Row:
    """What was measured of one generator. A value that does not exist is None, and `note` says why."""

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
        """The mean over the scenes of a metric; None where there is none."""
        return _mean([values[metric] for values in self.quality.values()])

    def corrected_mean(self, metric: str) -> float | None:
        """The same of corrected images."""
        return _mean([values[metric] for values in self.corrected.values()])


def images(argv: Sequence[str] = ()) -> int:
    """Time every spike-to-image generator, and score it at the held-out cameras of the given scenes.

    Writes the table to OUT/images.csv, and for each scene OUT/strip_SCENE.png: truth, images, errors.
    """
    p = argparse.ArgumentParser("spike4dgs speed images", description=images.__doc__)
    p.add_argument("scenes", nargs="*", type=Path, help="scene folders; without any, only time is measured")
    p.add_argument("--repeats", type=int, default=5, help="the median of so many images counts")
    p.add_argument("--out", type=Path, default=Path("runs/images"), help="folder for the table and the strips")
    p.add_argument("--allow-gaps", action="store_true", help="accept recordings with gaps")
    a = p.parse_args(list(argv))
    scenes = [open_scene(path, a.allow_gaps) for path in a.scenes]
    rows = measure_generators(scenes, a.repeats)
    title = f"Images from spikes, median ms of {a.repeats}, quality at the held-out cameras of {len(scenes)} scene(s)"
    show_table(title, _columns(scenes), [_texts(r) for r in rows], a.out / "images.csv", [r.note for r in rows])
    if len(scenes) > 1:
        scored = [row for row in rows if row.quality]
        by_scene = [(s.id, *(_show("psnr", row.quality[s.id]["psnr"]) for row in scored)) for s in scenes]
        columns = ("scene", *(row.title for row in scored))
        show_table("PSNR by scene", columns, by_scene, a.out / "images_by_scene.csv")
    for scene in scenes:
        write_strip(a.out / f"strip_{scene.id}.png", scene, rows)
    if scenes:
        print(f"images: {a.out}/strip_*.png")
    return 0


def measure_generators(scenes: Sequence[Scene], repeats: int) -> list[Row]:
    """A row for each entry of IMAGES, then for what the paper has besides, for TFSTP in numpy, and for spikezoo's."""
    rows = []
    for name, maker in IMAGES.items():
        row = _measure(Row(name, OURS, note=STANDS_IN.get(name, "")), partial(_ours, maker), scenes, repeats)
        rows.append(replace(row, corrected=_corrected(maker, scenes)) if row.quality else row)
    rows += [Row(name, OURS, note="not among the generators") for name in TABLE_6 if name not in IMAGES]
    rows.append(_measure_numpy(repeats))
    return rows + [_measure_spikezoo(name, scenes, repeats) for name in SPIKEZOO]


def _ours(maker: ImageMaker, stream: SpikeStream, tick: int, gain: float) -> Draw:
    return lambda: maker(stream, [tick], gain)[0]


def _measure(row: Row, prepare: Prepare, scenes: Sequence[Scene], repeats: int, scored: bool = True) -> Row:
    """Fill in time and quality; a generator that cannot run, for lack of weights say, gives a row with the reason."""
    try:
        ms = time_ms(prepare(fired_stream(TICKS, WIDTH, HEIGHT), TICKS // 2, 1.0), repeats)[1]
    except UserError as e:
        return replace(row, note=str(e))
    scene_ms = time_ms(prepare(*_view(scenes[0], middle_target(scenes[0]))), repeats)[1] if scenes else None

    def draw(scene: Scene, target: Target) -> Float32:
        return prepare(*_view(scene, target))()

    quality = {scene.id: _score(draw, scene) for scene in scenes} if scored else {}
    return replace(row, ms=ms, scene_ms=scene_ms, quality=quality)


def _corrected(maker: ImageMaker, scenes: Sequence[Scene]) -> Quality:
    """Scores of images that know their camera, on scenes that have the held-out cameras' calibration recordings."""
    known = [s for s in scenes if all(s.recordings(c) for c in s.test)]
    cameras = {(s.id, c): estimate(r) for s in known for c in s.test if (r := s.recordings(c))}

    def draw(scene: Scene, target: Target) -> Float32:
        stream, tick, gain = _view(scene, target)
        picture = maker(stream, [tick], gain, cameras[scene.id, target.camera])[0]
        return np.nan_to_num(picture)  # a dead pixel counts as black: something has to be compared

    return {scene.id: _score(draw, scene) for scene in known}


def _view(scene: Scene, target: Target) -> tuple[SpikeStream, int, float]:
    return scene.stream(target.camera), target.tick, scene.radiance_gain


def middle_target(scene: Scene) -> Target:
    """The scored image in the middle of the list. Raises UserError for a scene without any."""
    if not scene.targets:
        raise problem(scene.root, "a scene with targets", "none in targets.json", "use a scene that has ground truth")
    return scene.targets[len(scene.targets) // 2]


def _score(draw: Callable[[Scene, Target], Float32], scene: Scene) -> dict[str, float | None]:
    """The means over a scene's targets."""
    found: dict[str, list[float | None]] = {metric: [] for metric in QUALITY}
    for target in scene.targets:
        picture, truth, moving = draw(scene, target), scene.ground_truth(target), scene.moving(target)
        where = f"{scene.id}, {target.name}"
        check_images(truth, picture, moving, where)
        pair = ImagePair(truth, picture, moving, where)
        for metric in QUALITY:
            found[metric].append(METRICS[metric].measure(pair))
    return {metric: _mean([v for v in values if v is not None]) for metric, values in found.items()}


def _mean(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return math.fsum(known) / len(known) if known and len(known) == len(values) else None


def _measure_numpy(repeats: int) -> Row:
    stream = fired_stream(TICKS, WIDTH, HEIGHT)
    spikes = stream.window(0, TICKS).astype(bool)
    plain = tfstp_plainly(spikes, TICKS // 2)
    error = float(np.nanmax(np.abs(plain - tfstp_image(stream, TICKS // 2))))
    ms = time_ms(lambda: tfstp_plainly(spikes, TICKS // 2), repeats)[1]
    return Row("tfstp", "numpy", ms, note=f"whole history, float64; {OURS} is within {error:.0e} spikes per tick")


def tfstp_plainly(spikes: NDArray[np.bool_], tick: int) -> NDArray[np.float64]:
    """TFSTP from the published equations, all pixels of [T, H, W] at once; NaN where no interval contains `tick`."""
    last = np.full(spikes.shape[1:], -1)
    u, q = np.full(last.shape, U0), np.zeros(last.shape)  # q = 1 - R, which float64 could not hold as R
    done = np.zeros(last.shape, bool)
    for t, fired in enumerate(spikes):
        now = fired & ~done & (last >= 0)
        gap, u_now, q_now = (t - last)[now], u[now], q[now]
        q[now] = (q_now + u_now - q_now * u_now) * np.exp(-gap / D_TICKS)
        u[now] = U0 + (u_now + JUMP * (1 - u_now) - U0) * np.exp(-gap / F_TICKS)
        last[fired] = t
        done |= now & (t >= tick)
        if done.all():
            break
    with np.errstate(divide="ignore", invalid="ignore"):
        interval_r = -D_TICKS * np.log(q / (q + u - q * u))
        interval_u = -F_TICKS * np.log((u - U0) / (JUMP - U0 + u * (1 - JUMP)))
        return np.where(done, (1 / interval_r + 1 / interval_u) / 2, np.nan)


def _measure_spikezoo(name: str, scenes: Sequence[Scene], repeats: int) -> Row:
    """A row of spikezoo's model, which may lack packages, name a device that is not there, or fail as it likes."""
    folder, model = SPIKEZOO[name]
    row = Row(name, "spikezoo", note=UNTRAINED.get(name, ""))
    try:
        if (module := module_of("spikezoo", f"archs/{folder}/nets.py")) is None:
            return replace(row, note="not installed")
        net = getattr(module, model)().eval()
        return _measure(row, partial(_zoo, net), scenes, repeats, scored=name not in UNTRAINED)
    except Exception as e:  # somebody else's package
        return replace(row, note=f"does not run here: {type(e).__name__}: {e}")


def _zoo(net: Any, stream: SpikeStream, tick: int, gain: float) -> Draw:
    """One of spikezoo's models on the 41 ticks around `tick`, or the nearest ones that the clip has."""
    import torch

    start = max(0, min(tick - _WINDOW // 2, stream.n_ticks - _WINDOW))
    spikes = torch.from_numpy(stream.window(start, start + _WINDOW)).float()[None]  # [1, T, H, W]
    spikes = torch.nn.functional.pad(spikes, (0, -stream.width % 4, 0, -stream.height % 4), mode="replicate")

    def draw() -> Float32:
        with torch.no_grad():
            image = net(spikes)[0, 0, : stream.height, : stream.width].numpy()
        return np.asarray(image / gain, np.float32)

    return draw


def _columns(scenes: Sequence[Scene]) -> tuple[str, ...]:
    size = f"ms {scenes[0].meta['width']}x{scenes[0].meta['height']}" if scenes else "ms, scene"
    quality = ("PSNR", "SSIM", "PSNR, moving", "PSNR, corrected", "moving, corrected")
    return ("images", f"ms {WIDTH}x{HEIGHT}", size, *quality, "in Table 6", "its PSNR", "its SSIM")


def _texts(row: Row) -> tuple[str, ...]:
    paper = TABLE_6.get(row.name) if row.by == OURS else None
    printed = (paper.column, f"{paper.psnr:.2f}", f"{paper.ssim:.3f}") if paper else ("-", "-", "-")
    ms = ("-" if v is None else f"{v:.3g}" if v < 100 else f"{v:.0f}" for v in (row.ms, row.scene_ms))
    corrected = (_show(metric, row.corrected_mean(metric)) for metric in ("psnr", "psnr_dynamic"))
    return (row.title, *ms, *(_show(metric, row.mean(metric)) for metric in QUALITY), *corrected, *printed)


def _show(metric: str, value: float | None) -> str:
    return METRICS[metric].format(value)


def write_strip(path: Path, scene: Scene, rows: Sequence[Row]) -> None:
    """Write a PNG of the middle target: truth and the image of each of our generators, error maps below."""
    from matplotlib.figure import Figure

    target = middle_target(scene)
    truth = scene.ground_truth(target)
    makers = [(row, IMAGES[row.name]) for row in rows if row.by == OURS and row.quality]
    width = 2.8
    size = (width * (len(makers) + 1), 2 * width * scene.meta["height"] / scene.meta["width"] + 0.7)
    figure = Figure(figsize=size, dpi=120, layout="compressed")
    axes = figure.subplots(2, len(makers) + 1, squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    _image(axes[0, 0], f"truth, {scene.id}, tick {target.tick}", encode_srgb(truth), "gray", 255)
    for (top, below), (row, maker) in zip(axes[:, 1:].T, makers, strict=True):
        image = _ours(maker, *_view(scene, target))()
        psnr = _show("psnr", row.quality[scene.id]["psnr"])
        _image(top, f"{row.name}, {psnr} dB over the scene", encode_srgb(image), "gray", 255)
        shown = _image(below, "", np.abs(np.clip(image, 0, 1) - np.clip(truth, 0, 1)), "magma", _ERROR_MAX)
    if makers:
        scale = axes[1, 0].inset_axes((0.1, 0.45, 0.8, 0.1))
        figure.colorbar(shown, cax=scale, orientation="horizontal").set_label("absolute error (1 = white)", fontsize=8)
        scale.tick_params(labelsize=7)
    with atomic_path(path) as part:
        figure.savefig(part, metadata={"Software": None})


def _image(axis: Any, title: str, image: NDArray[Any], cmap: str, most: float) -> Any:
    axis.set_title(title, fontsize=8)
    return axis.imshow(image, cmap=cmap, vmin=0, vmax=most, interpolation="nearest")
