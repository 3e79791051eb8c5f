"""Train Spk2ImgNet on scenes.

Loss: L1(truth, rate / gain), and the published small weight on the four branches' own estimates. The publication has
ground truth at the middles of all five blocks; a scene has it every 20 ticks, that is at the middle of the middle block
only. The extractor is shared by the blocks, so its estimates are held to the truth there, with the weight of all five.

Everything random is drawn from (seed, step): a killed run goes on from its checkpoint as if it had never stopped.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spike4dgs.baselines.images.spk2img.data import Batch, Example, draw
from spike4dgs.baselines.images.spk2img.maker import WEIGHTS, Card, reconstruct
from spike4dgs.baselines.images.spk2img.network import BLOCK_STARTS, MIDDLE, Reconstruction, Spk2ImgNet
from spike4dgs.benchmark.files import sha256_json
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.method.checkpoint import resume_training, save_training
from spike4dgs.method.gaussians.optimizer import WarmCosine, make_adam, set_learning_rate

# Width 64; Adam at 1e-4, a tenth of it after epoch 20 of 61; batches of 16 patches of 40x40 pixels.
PUBLISHED: dict[str, int] = {"width": 64, "epochs": 61, "batch": 16, "patch": 40}
_LINE_EVERY_S = 30.0  # between lines of progress
_SAVE_EVERY_S = 300.0  # between checkpoints
_SCORED_IMAGES = 8  # of each hidden scene


@dataclass(frozen=True)
class TrainingSettings:
    """Hyper-parameters. Small networks need a higher learning rate than the published one."""

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
        self.adam = make_adam({"network": list(self.network.parameters())}, (0.9, 0.999))
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
        self.adam.zero_grad(set_to_none=True)
        loss.backward()
        # One bad patch must not undo a small network: gradients are a tenth of this once it has learned the mean.
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.adam.step()
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
