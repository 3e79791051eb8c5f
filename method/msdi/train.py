"""Train MSDI on training bursts.

Loss: L1 of the images in radiance, which trains extractor and generator, and DUSt3R's confidence-weighted regression of
points (`losses`), which trains everything behind them. Each step has a fixed number of views: few samples of many
views, or many of few.

All randomness comes from (seed, step): on one machine, with the same data, a killed run continues from its checkpoint
with the bits of a run that never stopped. Steps of weights that begin a training count for its batches and its card,
not for its schedule.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spike4dgs.benchmark.environment import device_type
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import sha256_file, sha256_json, write_text
from spike4dgs.benchmark.scene.training_bursts import BurstFile, open_folder
from spike4dgs.benchmark.variants import FIRST_SEASON_VARIANT, FIRST_TRAINING_VARIANT
from spike4dgs.benchmark.weights import read_tensors
from spike4dgs.method.checkpoint import resume_training, save_training
from spike4dgs.method.gaussians.optimizer import Adam
from spike4dgs.method.msdi.checkpoints import transfer
from spike4dgs.method.msdi.config import MsdiConfig
from spike4dgs.method.msdi.evaluate import Scores, evaluate
from spike4dgs.method.msdi.inputs import Sensors
from spike4dgs.method.msdi.losses import TrainingSettings, image_loss, point_loss
from spike4dgs.method.msdi.network import Msdi, has_bfloat16
from spike4dgs.method.msdi.records import (
    Curve,
    StartWeights,
    model_card,
    note_shards,
    plot_calibration,
    plot_curves,
)
from spike4dgs.method.msdi.training_data import Batch, Bursts, check_ticks
from spike4dgs.method.msdi.weights import WEIGHTS, Card

ROW_EVERY = 50  # steps between rows of the losses; checkpoints are written at rows only
_LINE_EVERY_S = 30.0  # between lines of progress
_SAVE_EVERY_S = 300.0  # between checkpoints
_PREPARERS = 8  # threads that make batches ahead, for a GPU
_SCORED_BURSTS = 36  # of the hidden ones


@dataclass(frozen=True)
class StepLosses:
    """Losses of one step."""

    total: float
    image_l1: float  # radiance
    points: float


class Training:
    """A training in progress."""

    def __init__(self, data: Bursts, config: MsdiConfig, settings: TrainingSettings, device: str, seed: int) -> None:
        check_ticks(config.ticks)
        self.data, self.settings, self.device, self.seed = data, settings, device, seed
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = Msdi(config).to(device).train()
        images: list[Tensor] = [*self.network.extractor.parameters(), *self.network.generator.parameters()]
        own = {id(p) for p in images}
        points: list[Tensor] = [p for p in self.network.parameters() if id(p) not in own]
        self.adam = Adam({"images": images, "points": points}, (0.9, 0.999))
        self.step = 0
        self.before = 0  # steps of the weights that began the training
        self._take = _ahead(self.batch, settings.steps) if device_type(device) == "cuda" else self.batch

    def batch(self, step: int) -> Batch:
        """Return the batch of a step, a function of the seed and of the steps up to it."""
        rng = np.random.default_rng([self.seed, self.before + step])
        views = int(rng.integers(2, min(self.settings.most_views, self.settings.views, self.data.views) + 1))
        return self.data.draw(max(1, self.settings.views // views), views, self.network.config.ticks, rng)

    def train_step(self) -> StepLosses:
        """Train for one step and return its losses."""
        batch = self._take(self.step)
        spikes, rate, points, intrinsics, sensitivity, dark = (
            torch.from_numpy(a).to(self.device, non_blocking=True)
            for a in (batch.spikes, batch.rate, batch.points, batch.intrinsics, batch.sensitivity, batch.dark)
        )
        draws = np.random.default_rng([self.seed, self.before + self.step, 1])
        known = draws.random() >= self.settings.unknown_share
        sensors = Sensors(sensitivity, dark) if draws.random() >= self.settings.raw_share else None
        kind = device_type(self.device)
        half = kind == "cuda" and has_bfloat16(torch.device(self.device))
        with torch.random.fork_rng(devices=[]), torch.autocast(kind, torch.bfloat16, enabled=half):
            torch.manual_seed(int(draws.integers(1 << 62)))  # the numbers of the views
            found = self.network(spikes, intrinsics if known else None, sensors)
        image_l1 = image_loss(found.images, rate) / batch.gain
        of_points = point_loss(found.points, found.confidence, points)
        total = image_l1 + of_points  # they share no parameters: there is nothing to weigh
        self.adam.zero_grad()
        total.backward()
        learning_rates = self.settings.learning_rates(self.step)
        for group in self.adam.groups:
            group.lr = learning_rates[group.name]
        self.adam.step_clipped()
        self.step += 1
        return StepLosses(total.item(), image_l1.item(), of_points.item())

    def save(self, path: Path, key: str) -> None:
        """Write everything needed to continue."""
        save_training(path, self.step, self.network, self.adam, key)

    def resume(self, path: Path, key: str) -> None:
        """Continue from a checkpoint if there is one. Raises UserError for a damaged or foreign one."""
        self.step = resume_training(path, self.network, self.adam, key) or self.step


def _ahead(make: Callable[[int], Batch], steps: int) -> Callable[[int], Batch]:
    """Return `make` for rising steps; other threads make the next batches while the caller uses one."""
    pool = ThreadPoolExecutor(_PREPARERS)
    waiting: dict[int, Future[Batch]] = {}

    def take(step: int) -> Batch:
        for coming in range(step, min(step + 2 * _PREPARERS, steps)):
            if coming not in waiting:
                waiting[coming] = pool.submit(make, coming)
        return waiting.pop(step).result()

    return take


def training_shards(data: Path) -> tuple[list[BurstFile], list[BurstFile]]:
    """Return the shards of a folder to train on, and the hidden ones. Raises UserError for variants kept for tests."""
    files = open_folder(data)
    learned, hidden = ([f for f in files if f.facts.hidden is h] for h in (False, True))
    allowed = range(FIRST_TRAINING_VARIANT, FIRST_SEASON_VARIANT)
    if wrong := [f.facts.id for f in learned if f.facts.variant not in allowed]:
        expected = f"hidden variants and those from {allowed.start} to {allowed[-1]}"
        raise problem(data, expected, ", ".join(wrong), "remove them: they are kept for tests")
    if not learned:
        raise problem(data, "shards to train on", "hidden variants only", "make more with `spike4dgs make-msdi-data`")
    return learned, hidden


def checkpoint_key(settings: TrainingSettings, config: str, seed: int, start_sha256: str | None) -> str:
    """Return the hash that ties a checkpoint to its training."""
    # Checkpoints of earlier versions have the learning rates under these names.
    names = {"lr_points": "rate", "lr_images": "image_rate"}
    facts = {names.get(name, name): value for name, value in asdict(settings).items()}
    return sha256_json([facts, config, seed, start_sha256])


def start_from(network: Msdi, path: Path) -> StartWeights:
    """Take the weights of an earlier training, or those of a file of Fast3R or DUSt3R, in place; return their facts.

    Raises UserError for a damaged file and for the weights of something else.
    """
    fix = "name a file that train-msdi wrote, or one of Fast3R or DUSt3R"
    state = read_tensors(path, "weights in safetensors format", fix)
    own = network.state_dict()
    if {n: t.shape for n, t in state.items()} == {n: t.shape for n, t in own.items()}:
        network.load_state_dict({name: tensor.float() for name, tensor in state.items()})
        card = WEIGHTS.read_card(path)
        return StartWeights(path.name, sha256_file(path), frozenset(card.trained_on), card.steps)
    transfer(network, state, path)
    return StartWeights(path.name, sha256_file(path))


class Run:
    """A training with its files in the folder `out`, continued from its checkpoint."""

    def __init__(
        self, training: Training, hidden: list[BurstFile], key: str, out: Path, start: StartWeights | None = None
    ) -> None:
        self.training, self.key, self.out, self.start = training, key, out, start
        training.before = start.steps if start else 0
        training.resume(self.checkpoint, key)
        earlier = start.shards if start else frozenset[str]()
        self.seen = note_shards(out / "trained_on.json", training.data.files, earlier, fresh=training.step == 0)
        ticks, most = training.network.config.ticks, training.settings.most_views
        self.hidden = Bursts(hidden).fixed(_SCORED_BURSTS, most, ticks) if hidden else []
        self.losses, self.scores = (Curve(out / f"{name}.csv", training.step) for name in ("losses", "scores"))

    @property
    def checkpoint(self) -> Path:
        """The file to continue from."""
        return self.out / "checkpoint.safetensors"

    def run(self) -> None:
        """Train to the last step, and write everything again at the end."""
        training, last = self.training, self.training.settings.steps
        first, start = training.step, time.perf_counter()
        shown = saved = start
        recent: list[StepLosses] = []
        if first == last:
            self.export()  # a run that ended may lack them
        while training.step < last:
            recent.append(training.train_step())
            now, step = time.perf_counter(), training.step
            if now - shown > _LINE_EVERY_S or step == last:
                shown = now
                left = (now - start) / (step - first) * (last - step)
                note = f"L1 {recent[-1].image_l1:.4f}, points {recent[-1].points:.3f}"
                print(f"step {step}/{last}, {note}, {now - start:.0f} s, about {left:.0f} s left", flush=True)
            if step % ROW_EVERY and step != last:
                continue
            names = ("total", "image_l1", "points")
            self.losses.add(step, {n: float(np.mean([getattr(r, n) for r in recent])) for n in names})
            recent = []
            if step % training.settings.score_every == 0 or step == last:
                self.export()
            if now - saved > _SAVE_EVERY_S or step == last:
                training.save(self.checkpoint, self.key)
                self.losses.write()
                saved = time.perf_counter()

    def export(self) -> None:
        """Score the weights as they are; write them, the curves and the model card."""
        training = self.training
        scores = evaluate(training.network, self.hidden, training.device) if self.hidden else Scores({}, None)
        measured = {name: round(value, 4) for name, value in scores.measured.items()}
        steps = training.before + training.step
        card = Card(training.network.config.name, steps, training.seed, self.seen, measured)
        path = self.out / f"msdi-{card.config}.safetensors"
        digest = WEIGHTS.save(path, training.network, card)
        self.scores.add(training.step, scores.measured)
        self.scores.write()
        self.losses.write()
        plot_curves(self.out / "curves.png", self.losses.rows, self.scores.rows)
        if scores.calibration is not None:
            plot_calibration(self.out / "calibration.png", scores.calibration)
        facts = [f.facts for f in training.data.files]
        write_text(self.out / "README.md", model_card(card, training.settings, digest, facts, self.start))
        shown = "".join(f", {n} {measured[n]:g}" for n in ("psnr_db", "tfp_psnr_db", "point_error") if n in measured)
        print(f"step {training.step}, written: {path}{shown}", flush=True)
