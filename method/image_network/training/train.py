"""Train the image network on bursts of `make-msdi-data`.

Processes beside the training make the next batches, each a function of (seed, step) alone: a killed training goes on
with the batches of one that never stopped. Steps of weights that begin a training count for its batches and its card,
not for its schedule. The weights in use are a running mean.
"""

from __future__ import annotations

import copy
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset

from spike4dgs.benchmark.environment import available_cores, device_type
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import sha256_json
from spike4dgs.benchmark.scene.training_bursts import BurstFile
from spike4dgs.method.checkpoint import resume_training, save_training
from spike4dgs.method.gaussians.optimizer import Adam, set_learning_rate
from spike4dgs.method.image_network.config import MOVING_LOSS, ImageConfig, ImageTraining
from spike4dgs.method.image_network.network import ImageNetwork, log_mse
from spike4dgs.method.image_network.training.data import ImageBatch, crop_size, draw
from spike4dgs.method.image_network.weights import WEIGHTS
from spike4dgs.method.models.network_weights import ConfigCard
from spike4dgs.method.msdi.records import Curve, note_shards
from spike4dgs.method.torch_state import follow

ROW_EVERY = 100  # steps between rows of the losses
_SAVE_EVERY_S = 60.0
_PER_DECIBEL = np.log(10) / 10


@dataclass(frozen=True)
class _Batches(Dataset[ImageBatch]):
    """The batch of each step."""

    files: Sequence[BurstFile]
    settings: ImageTraining
    seed: int
    before: int  # steps of the weights that began the training
    first: int

    def __len__(self) -> int:
        return self.settings.steps - self.first

    def __getitem__(self, index: int) -> ImageBatch:
        step = self.before + self.first + index
        return draw(self.files, self.settings, np.random.default_rng([self.seed, step]))


def _alone(worker: int) -> None:
    """Keep a worker process and its kernels' threads on one core."""
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[worker % len(cores)]})


class ImageNetworkTraining:
    """A training in progress."""

    def __init__(
        self,
        files: Sequence[BurstFile],
        config: ImageConfig,
        settings: ImageTraining,
        device: str,
        seed: int,
        start: Path | None = None,
    ) -> None:
        """Begin at step 0, with random weights or with those of the file `start`.

        Raises UserError for shards whose crops differ in size, and for a damaged or foreign file, or one of another
        configuration.
        """
        sizes = {crop_size((f.facts.height, f.facts.width), settings) for f in files}
        if len(sizes) > 1:
            found = ", ".join(f"{w}x{h}" for h, w in sorted(sizes))
            raise problem("training bursts", "shards with room for crops of one size", found, "name those of one size")
        self.files, self.settings, self.device, self.seed = list(files), settings, device, seed
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.live = ImageNetwork(config)
        self.before, self.shards = 0, frozenset[str]()
        if start:
            card = WEIGHTS.read_card(start)
            self.before, self.shards = card.steps, frozenset(card.trained_on)
            WEIGHTS.fill(start, self.live, f"configuration {config.name}").train().requires_grad_(True)
        self.live.to(device)
        self.network = copy.deepcopy(self.live)  # of the running mean of the weights: the one to use
        self.adam = Adam({"all": list(self.live.parameters())}, (0.9, 0.999))
        self.step = 0

    @property
    def networks(self) -> nn.ModuleDict:
        """Everything that a checkpoint keeps of the weights."""
        return nn.ModuleDict({"live": self.live, "mean": self.network})

    def batches(self) -> Iterator[ImageBatch]:
        """Yield the batches of this step and all later ones."""
        workers = max(1, available_cores() - 1)
        data = _Batches(self.files, self.settings, self.seed, self.before, self.step)
        yield from DataLoader(
            data, batch_size=None, num_workers=workers, prefetch_factor=4, collate_fn=_same, worker_init_fn=_alone
        )

    def train_step(self, batch: ImageBatch) -> tuple[float, float]:
        """Train for one step; return by how much the network's PSNR exceeds `adaptive`'s, and where things move."""
        names = ("channels", "spikes", "truth", "moving")
        channels, spikes, truth, moving = (getattr(batch, n).to(self.device, non_blocking=True) for n in names)
        weights = torch.ones_like(truth), moving.to(truth)
        kind = device_type(self.device)
        with torch.autocast(kind, torch.bfloat16, enabled=kind == "cuda"):
            found = self.live(channels, spikes)
        losses = torch.stack([log_mse(found, truth, weight) for weight in weights])
        self.adam.zero_grad()
        asked = losses[:1] if self.live.config.without == MOVING_LOSS else losses
        asked.sum().backward()  # type: ignore[no-untyped-call]
        set_learning_rate(self.adam, self.settings.learning_rate(self.step))
        self.adam.step_clipped()
        self.step += 1
        follow(self.network, self.live, self.step, self.settings.average)
        with torch.no_grad():
            before = torch.stack([log_mse(channels[:, 0], truth, weight) for weight in weights])
        gained, gained_moving = ((before - losses.detach()) / _PER_DECIBEL).tolist()
        return gained, gained_moving

    def save(self, path: Path, key: str) -> None:
        """Write everything needed to go on."""
        save_training(path, self.step, self.networks, self.adam, key)


def _same(batch: Any) -> Any:  # what DataLoader would stack
    return batch


def training_key(config: ImageConfig, settings: ImageTraining, seed: int, start: str | None = None) -> str:
    """Return the hash that ties a checkpoint to its training; `start` is the SHA-256 of the weights that began it."""
    return sha256_json([asdict(config), asdict(settings), seed, start])


def run(training: ImageNetworkTraining, key: str, out: Path) -> None:
    """Train to the last step, with checkpoint, weights, losses and list of shards in `out`."""
    checkpoint, last = out / "checkpoint.safetensors", training.settings.steps
    training.step = resume_training(checkpoint, training.networks, training.adam, key)
    seen = note_shards(out / "trained_on.json", training.files, training.shards, fresh=training.step == 0)
    curve = Curve(out / "losses.csv", training.step)
    recent: list[tuple[float, float]] = []
    saved = start = time.perf_counter()
    first = training.step

    def export() -> None:
        steps = training.before + training.step
        card = ConfigCard(training.network.config.name, steps, training.seed, seen)
        WEIGHTS.save(out / "images.safetensors", training.network, card)
        curve.write()

    if first == last:
        export()  # a run that ended may lack them
    for batch in training.batches():
        recent.append(training.train_step(batch))
        step, now = training.step, time.perf_counter()
        if step % ROW_EVERY and step != last:
            continue
        gained, moving = (float(x) for x in np.mean(recent, axis=0))
        recent = []
        curve.add(step, {"gained_db": gained, "gained_moving_db": moving})
        left = (now - start) / (step - first) * (last - step)
        note = f"{gained:+.2f} dB on adaptive, {moving:+.2f} where things move"
        print(f"step {step}/{last}: {note}; {now - start:.0f} s, about {left:.0f} s left", flush=True)
        if now - saved > _SAVE_EVERY_S or step == last:
            export()  # before the checkpoint, which says that they are there
            training.save(checkpoint, key)
            saved = now
