"""The one trainer of all recipes: the stages of `schedule`, static and deforming; several views of one time per step.

Everything random is drawn from generators seeded by (seed, step), so that the step number is the whole random state
and a fit that resumes from a checkpoint gives the bits of one that never stopped (on the CPU).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.method import Progress
from spike4dgs.method.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from spike4dgs.method.gaussians.density import GradientStatistics, refine
from spike4dgs.method.gaussians.optimizer import Decay, apply_edit, export_state, import_state, make_adam, set_rates
from spike4dgs.method.gaussians.parameters import Edit, Gaussians
from spike4dgs.method.motion.base import Motion
from spike4dgs.method.observations.lookup import moving
from spike4dgs.method.observations.training_images import TrainingImages
from spike4dgs.method.pose_refinement import Poses
from spike4dgs.method.schedule import Stage, choose_time, stages
from spike4dgs.method.settings import TrainSettings
from spike4dgs.method.splat import RenderOutput, Splats, Views, render
from spike4dgs.method.splat.background import Background
from spike4dgs.method.supervision.base import Sample, Supervision


def seeded(seed: int, step: int) -> torch.Generator:
    """The random numbers of one step."""
    return torch.Generator().manual_seed((seed * 1_000_003 + step) % 2**63)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Torch's own threads spin while they wait and take the cores from the rasteriser's, which do most of the work.

    Measured on 2 busy cores: 500 ms a step with torch's two threads, 36 ms with one.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Trainer:
    """A fit in progress. `scale` is the scene's size in metres, which relates learning rates to the world."""

    def __init__(
        self,
        footage: TrainingImages,
        gaussians: Gaussians,
        motion: Motion,
        supervision: Supervision,
        settings: TrainSettings,
        *,
        scale: float,
        seed: int,
    ) -> None:
        if settings.refine_poses and settings.freeze_still:
            fix = "choose one of them: a background is projected once"
            raise problem("settings", "refine_poses or freeze_still", "both", fix)
        self.training_images, self.motion, self.supervision = footage, motion, supervision
        self.settings, self.scale, self.seed = settings, scale, seed
        self.plan = stages(settings, motion.moves, motion.rests_first, motion.pieces)
        self.total = sum(s.steps for s in self.plan)
        self.step = 0
        self.gaussians = gaussians.trainable()
        self.ended: dict[int, Gaussians] = {}  # the pieces of the clip that are fitted
        self.still = gaussians.rows(torch.zeros(len(gaussians), dtype=torch.bool))  # frozen: the background
        self.background: Background | None = None
        self.poses = Poses(footage.views, scale)
        self._begin(self.plan[0])

    @property
    def stage(self) -> Stage:
        """The stage of the current step."""
        return next(s for s in reversed(self.plan) if s.first <= self.step)

    def _begin(self, stage: Stage) -> None:
        """Start a stage as 4DGS does: a fresh optimiser, and nothing gathered for densification."""
        s = self.settings
        own = {**self.supervision.groups(), **(self.motion.groups() if stage.deforms else {})}
        if s.refine_poses:
            own["poses"] = [self.poses.xi], Decay(s.pose_rate, s.pose_rate_last)
        self.rates = {
            "means": Decay(s.means_rate * self.scale, s.means_rate_last * self.scale),
            "log_scales": Decay(s.scales_rate, s.scales_rate),
            "quats": Decay(s.quats_rate, s.quats_rate),
            "logits": Decay(s.logits_rate, s.logits_rate),
            "colors": Decay(s.colors_rate, s.colors_rate),
            **self.motion.rates(),
            **{name: rate for name, (_, rate) in own.items()},
        }
        groups = {name: [leaf] for name, leaf in self.gaussians.tensors().items()}
        self.adam = make_adam({**groups, **{name: list(p) for name, (p, _) in own.items()}}, (s.beta1, s.beta2))
        self.statistics = GradientStatistics.zero(len(self.gaussians), self.gaussians.means.device)

    def _continue(self, stage: Stage) -> None:
        """Go over to a stage: what is still becomes a background, or a piece of the clip ends and another begins."""
        if stage.neighbour is None:
            if stage.deforms and self.settings.freeze_still:
                self._freeze()
            return
        before = self.plan[self.plan.index(stage) - 1]
        self.ended[before.piece] = self.gaussians.detached()
        first = self.motion.continued(self.ended[stage.neighbour], forward=stage.piece > stage.neighbour)
        self.gaussians = first.trainable()

    def pieces(self) -> tuple[Gaussians, ...]:
        """What is fitted of each piece of the clip, in their order, once the fit is done."""
        fitted = {**self.ended, self.stage.piece: self.gaussians.detached()}
        return tuple(fitted[piece] for piece in sorted(fitted))

    def _freeze(self) -> None:
        """Make a background of the Gaussians at whose places no view sees a change."""
        moves = moving(self.gaussians.means.detach(), self.training_images) > self.settings.moving_change
        self._set_still(self.gaussians.rows(~moves))
        self.gaussians = self.gaussians.rows(moves).trainable()

    def _set_still(self, still: Gaussians) -> None:
        self.still, self.background = still, Background(still.splats(), self.training_images.views)

    def sample(self) -> Sample:
        """The current step's views and time."""
        footage, count = self.training_images, len(self.training_images.views)
        index = choose_time(self.settings, self.stage, self.step, len(footage.ticks))
        views = torch.arange(count)
        if self.settings.views_per_step < count:
            order = torch.randperm(count, generator=seeded(self.seed, self.step))
            views = order[: self.settings.views_per_step].sort().values
        tick = footage.ticks[index]
        images = footage.images[index][views]
        return Sample(tick / footage.n_ticks, tick, tuple(views.tolist()), images, self.step)

    def train_step(self) -> Tensor:
        """One step; returns the loss."""
        stage, sample = self.stage, self.sample()
        if self.step == stage.first and self.step:
            self._continue(stage)
            self._begin(stage)
        chosen = list(sample.views)
        views = self.poses.views(chosen) if self.settings.refine_poses else self._views(chosen)
        outputs: list[RenderOutput] = []

        def draw(t: float) -> Tensor:
            splats = self.motion.splats(self.gaussians, stage.within(t)) if stage.deforms else self.gaussians.splats()
            outputs.append(self.background.render(splats, chosen) if self.background else self._render(splats, views))
            image = outputs[-1].image
            return self.motion.image(image, views) if stage.deforms else image[..., 0]

        set_rates(self.adam, self.rates, stage.fraction(self.step))
        self.adam.zero_grad(set_to_none=True)
        loss = self.supervision(draw, sample)
        (loss + self.motion.regularizer() if stage.deforms else loss).backward()
        self.adam.step()
        for out in outputs:
            self.statistics.add(out)
        self.step += 1
        self._refine(stage)
        return loss.detach()

    def _render(self, splats: Splats, views: Views) -> RenderOutput:
        return render(splats, views)

    def _views(self, chosen: list[int]) -> Views:
        return Views(self.training_images.views.w2c[chosen], self.training_images.views.K[chosen], *self._size())

    def _size(self) -> tuple[int, int]:
        return self.training_images.views.width, self.training_images.views.height

    def _refine(self, stage: Stage) -> None:
        s, done = self.settings, self.step - stage.first
        if done % s.refine_every or done > s.refine_until * stage.steps:
            return
        width, height = self._size()
        density, most = (
            (s.max_moving_per_pixel, s.max_gaussians // 2) if self.background else (s.max_per_pixel, s.max_gaussians)
        )
        limit = min(round(density * width * height), most)
        rng = seeded(self.seed, self.step)
        for edit in refine(self.gaussians, self.statistics, s, self.scale, limit, rng):
            self.gaussians = apply_edit(self.adam, self.motion.born(edit, rng))
        if stage.deforms and 2 <= done // s.refine_every < 2 + s.guided_rounds:
            before = len(self.gaussians)
            more = self.motion.guide(self.gaussians, self.training_images, rng)
            index = torch.arange(len(more), device=more.means.device)
            if len(more) > before:
                self.gaussians = apply_edit(self.adam, Edit(more, torch.where(index < before, index, -1)))
        self.statistics = GradientStatistics.zero(len(self.gaussians), self.gaussians.means.device)

    def run(
        self, progress: Progress, checkpoint: Path | None = None, fit: str = "", checkpoint_s: float = 15.0
    ) -> None:
        """Train to the end, from `checkpoint` where it exists; it is written every `checkpoint_s` seconds.

        `fit` identifies the fit. Raises UserError for a damaged checkpoint or one of another fit.
        """
        saved = load_checkpoint(checkpoint, fit) if checkpoint else None
        if saved:
            self.restore(saved)
        written = time.monotonic()
        with one_torch_thread():
            while self.step < self.total:
                loss = self.train_step()
                if checkpoint and (time.monotonic() - written >= checkpoint_s or self.step == self.total):
                    save_checkpoint(checkpoint, self.state(), fit)
                    written = time.monotonic()
                if self.step % 10 == 0 or self.step == self.total:
                    progress(self.step, self.total, f"loss {loss.item():.4f}, {len(self.gaussians)} Gaussians")

    def state(self) -> Checkpoint:
        """Everything that later steps depend on."""
        parts = {
            "gaussians": self.gaussians.tensors(),
            "still": self.still.tensors(),
            **{f"piece{i}": g.tensors() for i, g in self.ended.items()},
            "motion": self.motion.state_dict(),
            "supervision": self.supervision.state_dict(),
            "poses": self.poses.state_dict(),
            "adam": export_state(self.adam),
            "pressure": {"gradient": self.statistics.gradient, "seen": self.statistics.seen},
        }
        return Checkpoint(self.step, {f"{part}.{k}": v for part, tensors in parts.items() for k, v in tensors.items()})

    def restore(self, saved: Checkpoint) -> None:
        """Go on from a checkpoint of the same fit."""
        device = self.gaussians.means.device
        on = {
            part: {k: v.to(device) for k, v in saved.part(part).items()} for part in ("gaussians", "still", "pressure")
        }
        self.step = saved.step
        self.gaussians = Gaussians.from_tensors(on["gaussians"]).trainable()
        if len(on["still"]["means"]):
            self._set_still(Gaussians.from_tensors(on["still"]))
        for stage in self.plan:
            if ended := saved.part(f"piece{stage.piece}"):
                self.ended[stage.piece] = Gaussians.from_tensors({k: v.to(device) for k, v in ended.items()})
        self.motion.load_state_dict(saved.part("motion"))
        self.supervision.load_state_dict(saved.part("supervision"))
        self.poses.load_state_dict(saved.part("poses"))
        # At a stage's first step the optimiser in the file is the last stage's, and train_step replaces it.
        stage = next(s for s in reversed(self.plan) if s.first < max(self.step, 1))
        self._begin(stage)
        import_state(self.adam, saved.part("adam"))
        self.statistics = GradientStatistics(on["pressure"]["gradient"], on["pressure"]["seen"])
