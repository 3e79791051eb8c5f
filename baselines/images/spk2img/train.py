"""Train Spk2ImgNet on scenes.

Loss: L1(truth, rate / gain), and the published small weight on the four branches' own estimates. The publication has
ground truth at the middles of all five blocks; a scene has it every 20 ticks, that is at the middle of the middle block
only. The extractor is shared by the blocks, so its estimates are held to the truth there, with the weight of all five.

Every image of a scene counts: those of the held-out camera (every 20 ticks) and the sparse ones of the others. The
public benchmark (variants 0, 3 and 4 of every world), development scenes (10 to 12) and hidden seasons are refused: no
training may see a scored scene.
Augmentation is exact: the eight symmetries of the square, and time reversal. An integrator's spikes played backwards
are those of one that saw the light backwards; the image of the start of tick t is then that of the end of tick t, so
the reversed window is taken one tick earlier.

Everything random is drawn from (seed, step): a killed run goes on from its checkpoint as if it had never stopped.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spike4dgs.baselines.images.spk2img.maker import WEIGHTS, Card, reconstruct
from spike4dgs.baselines.images.spk2img.network import BLOCK_STARTS, MIDDLE, Reconstruction, Spk2ImgNet
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import sha256_json
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.variants import HIDDEN_VARIANTS, PUBLIC_VARIANTS, is_reserved
from spike4dgs.method.checkpoint import resume_training, save_training
from spike4dgs.method.gaussians.optimizer import Adam, WarmCosine, set_learning_rate
from spike4dgs.method.images.base import HALF_WINDOW, WINDOW, window


@dataclass(frozen=True, eq=False)
class Example:
    """A stream, a tick, and the truth at the start of that tick."""

    stream: SpikeStream
    tick: int
    rate: Float32  # [H, W] spikes per tick: radiance times gain, and at most 1, where the sensor saturates
    moving: NDArray[np.int64]  # [M] flat indices of the pixels of the moving region
    gain: float  # spikes per tick of white


@dataclass(frozen=True, eq=False)
class Batch:
    """Patches of a training step."""

    spikes: Float32  # [B, 41, P, P] of 0 and 1
    rate: Float32  # [B, P, P]
    gain: Float32  # [B]


def open_for_training(folder: Path, allow_gaps: bool = False) -> Scene:
    """Open a scene folder.

    Raises UserError for one of the public benchmark or of a hidden season, and for a recording with gaps unless
    `allow_gaps`.
    """
    scene = open_scene(folder, allow_gaps)
    variant = scene.meta.get("source", {}).get("variant")
    fix = "make one with `spike4dgs make-dataset WORLD --variant 1`"
    if variant in PUBLIC_VARIANTS:
        raise problem(folder, "a training variant, such as 1", f"the public benchmark's variant {variant}", fix)
    if variant in HIDDEN_VARIANTS:
        raise problem(folder, "a training variant, such as 1", f"variant {variant}, which is kept for scores", fix)
    if is_reserved(variant):
        raise problem(folder, "a training variant", f"variant {variant}, which is kept for hidden seasons", fix)
    return scene


def read_examples(scene: Scene) -> list[Example]:
    """Return the examples of a scene whose spikes are complete, in the order of camera and tick.

    Raises UserError where the scene has none.
    """
    streams = {camera: scene.stream(camera) for camera in scene.meta["streams"]}
    paths = (PurePosixPath(name) for name in sorted(scene.manifest.files) if name.startswith("images/"))
    examples = []
    for path in paths:
        target = Target(path.parent.name, int(path.stem))
        if not _is_whole(streams[target.camera], target.tick):
            continue
        rate = np.clip(scene.ground_truth(target) * np.float32(scene.radiance_gain), 0, 1)
        moving = np.flatnonzero(scene.moving(target))
        examples.append(Example(streams[target.camera], target.tick, rate, moving, scene.radiance_gain))
    if not examples:
        found = "no image that has all its spikes"
        raise problem(scene.root, "a scene with ground truth", found, "train on another scene")
    return examples


def _is_whole(stream: SpikeStream, tick: int) -> bool:
    """Return whether no tick is missing from the windows around `tick`: the image's own, and the reversed one."""
    first, stop = tick - 1 - HALF_WINDOW, tick + HALF_WINDOW + 1  # the reversed window begins a tick earlier
    return all(gap.stop_tick <= first or stop <= gap.first_tick for gap in stream.gaps)


def draw(examples: Sequence[Example], count: int, patch: int, moving_share: float, rng: np.random.Generator) -> Batch:
    """Return `count` random patches, a `moving_share` of them around a moving pixel where there is one.

    `patch` is in pixels, at most the images' shorter side.
    """
    spikes = np.empty((count, WINDOW, patch, patch), np.float32)
    rate = np.empty((count, patch, patch), np.float32)
    gain = np.empty(count, np.float32)
    for k in range(count):
        example = examples[int(rng.integers(len(examples)))]
        spikes[k], rate[k] = _patch(example, patch, rng.random() < moving_share, rng)
        gain[k] = example.gain
    return Batch(spikes, rate, gain)


def _patch(example: Example, size: int, on_motion: bool, rng: np.random.Generator) -> tuple[Float32, Float32]:
    """Return one patch and its truth, turned, flipped and reversed at random."""
    height, width = example.rate.shape
    if on_motion and len(example.moving):
        y, x = divmod(int(rng.choice(example.moving)), width)
        top = int(np.clip(y - rng.integers(size), 0, height - size))
        left = int(np.clip(x - rng.integers(size), 0, width - size))
    else:
        top, left = int(rng.integers(height - size + 1)), int(rng.integers(width - size + 1))
    backwards = bool(rng.random() < 0.5)
    spikes = window(example.stream, example.tick - backwards)[:, top : top + size, left : left + size]
    rate = example.rate[top : top + size, left : left + size]
    if backwards:
        spikes = spikes[::-1]
    turns, flip = int(rng.integers(4)), rng.random() < 0.5
    spikes, rate = np.rot90(spikes, turns, axes=(1, 2)), np.rot90(rate, turns)
    if flip:
        spikes, rate = spikes[:, :, ::-1], rate[:, ::-1]
    return spikes.astype(np.float32), rate


_LINE_EVERY_S = 30.0  # between lines of progress
_SAVE_EVERY_S = 300.0  # between checkpoints
_SCORED_IMAGES = 8  # of each hidden scene


@dataclass(frozen=True)
class TrainingSettings:
    """Hyper-parameters. Small networks need a higher learning rate than the published one.

    Published: width 64; Adam at 1e-4, a tenth of it after epoch 20 of 61; batches of 16 patches of 40x40 pixels.
    """

    width: int = 8
    steps: int = 20_000
    batch: int = 8  # patches a step
    patch: int = 48  # pixels
    lr: float = 2e-3  # Adam's, after the warm-up; it falls to 0 with the cosine
    warm_up: int = 200  # steps
    moving_share: float = 0.5  # of the patches lie around a moving pixel: most of a scene is static
    estimate_weight: float = 0.02  # of each branch's estimate, as published

    @property
    def schedule(self) -> WarmCosine:
        """Adam's learning rate by step."""
        return WarmCosine(self.lr, self.warm_up, self.steps)


def loss_of(found: Reconstruction, rate: Tensor, gain: Tensor, estimate_weight: float) -> Tensor:
    """Return the L1 loss in radiance of the image and of the middle block's estimates. rate [B, P, P], gain [B]."""
    scale = 1 / gain
    image = ((found.rate - rate).abs().mean(dim=(1, 2)) * scale).mean()
    estimates = (found.estimates[:, MIDDLE] - rate[:, None]).abs().mean(dim=(2, 3))  # [B, 4]
    weight = estimate_weight * len(BLOCK_STARTS)
    return image + weight * (estimates.sum(dim=1) * scale).mean()


class Training:
    """A training in progress."""

    def __init__(self, examples: Sequence[Example], settings: TrainingSettings, device: str, seed: int) -> None:
        self.examples, self.settings, self.device, self.seed = examples, settings, device, seed
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = Spk2ImgNet(settings.width).to(device)
        self.adam = Adam({"network": list(self.network.parameters())}, (0.9, 0.999))
        self.step = 0

    def batch(self) -> Batch:
        """Return the current step's patches."""
        s = self.settings
        return draw(self.examples, s.batch, s.patch, s.moving_share, np.random.default_rng([self.seed, self.step]))

    def train_step(self) -> float:
        """Take one step and return its loss."""
        batch = self.batch()
        spikes = torch.from_numpy(batch.spikes).to(self.device, memory_format=torch.channels_last)
        rate, gain = (torch.from_numpy(a).to(self.device) for a in (batch.rate, batch.gain))
        set_learning_rate(self.adam, self.settings.schedule.at(self.step))
        loss = loss_of(self.network(spikes), rate, gain, self.settings.estimate_weight)
        self.adam.zero_grad()
        loss.backward()
        # One bad patch must not undo a small network: gradients are a tenth of this once it has learned the mean.
        self.adam.step_clipped()
        self.step += 1
        return loss.item()

    def save(self, path: Path, key: str) -> None:
        """Write a checkpoint."""
        save_training(path, self.step, self.network, self.adam, key)

    def resume(self, path: Path, key: str) -> None:
        """Go on from a checkpoint if there is one. Raises UserError for a damaged or foreign one."""
        self.step = resume_training(path, self.network, self.adam, key) or self.step


def score(network: Spk2ImgNet, scene: Scene) -> float:
    """Return the mean PSNR in dB over targets of a scene, evenly chosen from its default split."""
    chosen = scene.targets[:: max(1, len(scene.targets) // _SCORED_IMAGES)]
    values = []
    for target in chosen:
        found = reconstruct(network, scene.stream(target.camera), target.tick) / np.float32(scene.radiance_gain)
        pair = ImagePair(scene.ground_truth(target), found, scene.moving(target), f"{scene.id} {target.name}")
        values.append(METRICS["psnr"].measure(pair))
    return float(np.mean([v for v in values if v is not None]))


def run(training: Training, hidden: Sequence[Scene], names: tuple[str, ...], out: Path) -> None:
    """Train to the last step, from the checkpoint in `out` if there is one; `names`: of what it is trained on."""
    settings = training.settings
    facts = asdict(settings)
    facts["rate"] = facts.pop("lr")  # its name in the keys of checkpoints that earlier versions wrote
    key = sha256_json([facts, training.seed, names])
    training.resume(out / "checkpoint.safetensors", key)
    first, start = training.step, time.perf_counter()
    shown = saved = start
    losses: list[float] = []
    while training.step < settings.steps:
        losses.append(training.train_step())
        now = time.perf_counter()
        if now - shown > _LINE_EVERY_S or training.step == settings.steps:
            left = (now - start) / (training.step - first) * (settings.steps - training.step)
            note = f"loss {np.mean(losses):.4f}, {now - start:.0f} s, about {left:.0f} s left"
            print(f"step {training.step}/{settings.steps}, {note}", flush=True)
            shown, losses = now, []
        if now - saved > _SAVE_EVERY_S:
            training.save(out / "checkpoint.safetensors", key)
            _export(training, hidden, names, out)
            saved = time.perf_counter()
    training.save(out / "checkpoint.safetensors", key)
    _export(training, hidden, names, out)


def _export(training: Training, hidden: Sequence[Scene], names: tuple[str, ...], out: Path) -> None:
    """Write the weights as they are, with their scores, and say so."""
    scores = {s.id: round(score(training.network, s), 2) for s in hidden}
    card = Card(training.settings.width, training.step, training.seed, names, scores)
    path = out / f"spk2img-{card.width}.safetensors"
    digest = WEIGHTS.save(path, training.network, card)
    shown = "".join(f", {scene} {db:.2f} dB" for scene, db in scores.items())
    print(f"written: {path}, sha256 {digest}{shown}", flush=True)
