"""Train the matching network on bursts of `make-msdi-data`.

The rate of learning does not depend on a last step, and the weights in use are a running mean: a training can go on at
any time, for as long as it pays. All randomness comes from (seed, step): a killed run goes on with the bits of one that
never stopped, on the same machine and shards.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from torch import nn

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import sha256_json
from spike4dgs.benchmark.scene.training_bursts import BurstFile
from spike4dgs.method.checkpoint import resume_training, save_training
from spike4dgs.method.gaussians.optimizer import Adam, set_learning_rate
from spike4dgs.method.matching.config import MatcherConfig, MatcherTraining
from spike4dgs.method.matching.network import Matcher
from spike4dgs.method.matching.training.data import draw
from spike4dgs.method.matching.training.losses import MatchLosses, match_losses
from spike4dgs.method.matching.weights import WEIGHTS
from spike4dgs.method.models.network_weights import ConfigCard
from spike4dgs.method.msdi.records import Curve, note_shards
from spike4dgs.method.torch_state import follow, one_torch_thread, seeded

ROW_EVERY = 50  # steps between rows of the losses
_SAVE_EVERY_S = 120.0


class MatchTraining:
    """A training in progress."""

    def __init__(
        self,
        files: Sequence[BurstFile],
        config: MatcherConfig,
        settings: MatcherTraining,
        seed: int,
        start: Path | None = None,
    ) -> None:
        """Begin at step 0, or at the step of the weights `start`, whose optimiser is found anew by a warm-up.

        Raises UserError for shards of several image sizes, and for a damaged or foreign file, or one of another
        configuration.
        """
        sizes = {(f.facts.width, f.facts.height) for f in files}
        if len(sizes) > 1:
            found = ", ".join(f"{w}x{h}" for w, h in sorted(sizes))
            raise problem("training bursts", "shards of one image size", found, "name those of one size")
        self.files, self.settings, self.seed = list(files), settings, seed
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            live = Matcher(config)
        self.step, self.shards = 0, frozenset[str]()
        if start:
            card = WEIGHTS.read_card(start)
            WEIGHTS.fill(start, live, f"configuration {config.name}")
            live.train().requires_grad_(True)
            self.step, self.shards = card.steps, frozenset(card.trained_on)
        self.networks = nn.ModuleDict({"live": live, "mean": copy.deepcopy(live)})
        self.adam = Adam({"all": list(live.parameters())}, (0.9, 0.999))

    @property
    def network(self) -> Matcher:
        """The network of the running mean of the weights: the one to use."""
        mean = self.networks["mean"]
        assert isinstance(mean, Matcher)
        return mean

    @property
    def warm_steps(self) -> int:
        """The steps that the optimiser has seen: fewer than `step` where weights began the training."""
        state = next(iter(self.adam.state.values()), None)
        return int(state["step"]) if state else 0

    def train_step(self) -> MatchLosses:
        """Train for one step and return its losses."""
        batch = draw(self.files, self.settings, np.random.default_rng([self.seed, self.step]))
        live = self.networks["live"]
        assert isinstance(live, Matcher)
        generator = seeded(self.seed, self.step)
        features = live.extractor(batch.inputs)
        losses = match_losses(live, features, batch.views, batch.pairs, self.settings.jitter, generator)
        self.adam.zero_grad()
        losses.total.backward()  # type: ignore[no-untyped-call]
        set_learning_rate(self.adam, self.settings.learning_rate(self.step, self.warm_steps))
        self.adam.step_clipped()
        self.step += 1
        follow(self.network, live, self.step, self.settings.average)
        return losses

    def save(self, path: Path, key: str) -> None:
        """Write everything needed to go on."""
        save_training(path, self.step, self.networks, self.adam, key)

    def resume(self, path: Path, key: str) -> bool:
        """Go on from a checkpoint; return whether there is one. Raises UserError for a damaged or foreign one."""
        if there := path.is_file():
            self.step = resume_training(path, self.networks, self.adam, key)
        return there


def training_key(config: MatcherConfig, settings: MatcherTraining, seed: int, start: str | None = None) -> str:
    """Return the hash that ties a checkpoint to its training; `start` is the SHA-256 of the weights that began it.

    The number of steps is no part of it.
    """
    return sha256_json([asdict(config), asdict(settings), seed, *([start] if start else [])])


def run(training: MatchTraining, steps: int, key: str, out: Path, save_every_s: float = _SAVE_EVERY_S) -> None:
    """Train up to a step in one thread, with checkpoint, weights, losses and list of shards in `out`.

    Raises UserError where the weights that begin the training have that step behind them.
    """
    with one_torch_thread():
        _run(training, steps, key, out, save_every_s)


def _run(training: MatchTraining, steps: int, key: str, out: Path, save_every_s: float) -> None:
    checkpoint, losses = out / "checkpoint.safetensors", out / "losses.csv"
    resumed = training.resume(checkpoint, key)
    if not resumed and training.step >= steps:
        expected = f"more than the {training.step} steps of the weights that begin the training"
        raise problem("--steps", expected, str(steps), "give a larger number")
    seen = note_shards(out / "trained_on.json", training.files, training.shards, fresh=not resumed)
    curve = Curve(losses, training.step)
    recent: list[MatchLosses] = []
    saved = start = time.perf_counter()
    first = training.step

    def export() -> None:
        card = ConfigCard(training.network.config.name, training.step, training.seed, seen)
        WEIGHTS.save(out / "matcher.safetensors", training.network, card)
        curve.write()

    if first >= steps:
        export()  # a run that ended may lack them
    while training.step < steps:
        recent.append(training.train_step())
        step, now = training.step, time.perf_counter()
        if step % ROW_EVERY and step != steps:
            continue
        row = {name: float(np.mean([getattr(r, name) for r in recent])) for name in ("coarse", "found", "fine_px")}
        recent = []
        curve.add(step, row)
        left = (now - start) / (step - first) * (steps - step)
        shown = ", ".join(f"{name} {value:.3f}" for name, value in row.items())
        print(f"step {step}/{steps}: {shown}; {now - start:.0f} s, about {left:.0f} s left", flush=True)
        if now - saved > save_every_s or step == steps:
            export()  # before the checkpoint, which says that they are there
            training.save(checkpoint, key)
            saved = now
