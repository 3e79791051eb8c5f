"""The one trainer of all recipes: the stages of `schedule`, static and deforming; several views of one time per step.

Everything random comes from generators seeded by (seed, step), so that the step number is the whole random state
and a fit that resumes from a checkpoint gives the bits of one that never stopped (on the CPU). The charges that losses
on spikes begin with are seeded by the step alone: other seeds do not vary them.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from weakref import proxy

import torch
from torch import Tensor

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.method import Progress
from spike4dgs.method.array_path import ArrayPath
from spike4dgs.method.checkpoint import Checkpoint, run_steps
from spike4dgs.method.gaussians.density import DensitySettings, GradientStatistics, adapt_density
from spike4dgs.method.gaussians.optimizer import (
    Adam,
    Averages,
    Decay,
    apply_edit,
    export_state,
    import_state,
    set_learning_rates,
)
from spike4dgs.method.gaussians.parameters import Gaussians, appended
from spike4dgs.method.motion.base import Motion
from spike4dgs.method.motion.coherence import Coherence
from spike4dgs.method.pose_refinement import Poses
from spike4dgs.method.schedule import Stage, TrainerSettings, choose_time, choose_views, stages
from spike4dgs.method.splat import RenderOutput, Splats, Views, render
from spike4dgs.method.splat.background import Background
from spike4dgs.method.supervision.base import Sample, Supervision
from spike4dgs.method.torch_state import seeded
from spike4dgs.method.training_views.foreground import moving_points
from spike4dgs.method.training_views.instants import Corrections, RenderViews
from spike4dgs.method.training_views.light_layers import factor_at, lit, with_layers
from spike4dgs.method.training_views.training_images import TrainingImages


class Trainer:
    """A fit in progress. `scale` is the scene's size in metres, which relates learning rates to the world.

    Where the array moves along a `path`, Gaussians are those of the world, and nothing is a background: no pixel of
    the array shows the same thing for long.
    """

    def __init__(
        self,
        images: TrainingImages,
        gaussians: Gaussians,
        motion: Motion,
        supervision: Supervision,
        settings: TrainerSettings,
        density: DensitySettings,
        *,
        scale: float,
        seed: int,
        path: ArrayPath | None = None,
        parts: float = 1.0,
    ) -> None:
        if settings.refine_poses and (settings.freeze_background or images.spans is not None):
            expected = "either trainer.refine_poses, or trainer.freeze_background and images of known spans"
            raise problem("settings", expected, "both", "choose one: the latter are rendered from the given poses")
        if settings.average > 1 - density.refine_stop + 1e-9:  # 1 - 0.8 is less than 0.2
            stop = density.refine_stop
            expected = f"trainer.average of at most {1 - stop:g}, as density.refine_stop is {stop:g}"
            raise problem("settings", expected, f"{settings.average:g}", "average fewer steps")
        self.training_images, self.motion, self.supervision = images, motion, supervision
        self.settings, self.density, self.scale, self.seed, self.path = settings, density, scale, seed, path
        motion.pixel_filter = settings.pixel_filter
        self.plan = stages(settings, motion.moves, motion.rests_first, motion.pieces, parts)
        self.step, self.total = 0, sum(s.steps for s in self.plan)
        gaussians = with_layers(gaussians, images)
        self.gaussians = gaussians.trainable()
        self.ended: dict[int, Gaussians] = {}  # the pieces of the clip that are fitted
        self.background = gaussians.rows(torch.zeros(len(gaussians), dtype=torch.bool))  # none yet; frozen
        self.projected: Background | None = None
        self.snapshot: Gaussians | None = None  # the model that corrects means over time
        self.corrections: Corrections | None = None
        self.poses = Poses(images.views, scale)
        self.coherence = Coherence(motion.coherence, images.views)
        self._begin(self.plan[0])

    @property
    def stage(self) -> Stage:
        """The stage of the current step."""
        return next(s for s in reversed(self.plan) if s.first <= self.step)

    def _begin(self, stage: Stage) -> None:
        """Start a stage as 4DGS does: a fresh optimiser, and nothing gathered for densification."""
        s = self.settings
        self.close()
        self.snapshot = self.corrections = None
        self.coherence.forget()
        own = {**self.supervision.groups(), **(self.motion.groups() if stage.deforms else {})}
        if s.refine_poses:
            own["poses"] = [self.poses.xi], Decay(s.lr_poses, s.lr_poses_last)
        self.learning_rates = {
            "means": Decay(s.lr_means * self.scale, s.lr_means_last * self.scale),
            "log_scales": Decay(s.lr_scales, s.lr_last * s.lr_scales),
            "quats": Decay(s.lr_quats, s.lr_last * s.lr_quats),
            "logits": Decay(s.lr_opacities, s.lr_last * s.lr_opacities),
            "colors": Decay(s.lr_colors, s.lr_last * s.lr_colors),
            **self.motion.learning_rates(),
            **{name: rate for name, (_, rate) in own.items()},
        }
        groups = {name: [leaf] for name, leaf in self.gaussians.tensors().items()}
        self.adam = Adam({**groups, **{name: list(p) for name, (p, _) in own.items()}}, (s.beta1, s.beta2))
        self.statistics = GradientStatistics.zero(len(self.gaussians), self.gaussians.means.device)
        self.averages = Averages()

    def _continue(self, stage: Stage) -> None:
        """Go over to a stage: static Gaussians become a background, or a piece of the clip ends and another begins."""
        if stage.neighbour is None:
            if stage.deforms and self.settings.freeze_background and not self.path:
                self._freeze()
            return
        self.ended[self.plan[self.plan.index(stage) - 1].piece] = self.gaussians.detached()
        first = self.motion.next_piece(self.ended[stage.neighbour], forward=stage.piece > stage.neighbour)
        self.gaussians = first.trainable()

    def pieces(self) -> tuple[Gaussians, ...]:
        """Return the fitted Gaussians of each piece of the clip, in order, once the fit is done."""
        fitted = {**self.ended, self.stage.piece: self.gaussians.detached()}
        return tuple(fitted[piece] for piece in sorted(fitted))

    def _freeze(self) -> None:
        """Make a background of the Gaussians that do not move; the others set off."""
        moves = moving_points(self.gaussians.means.detach(), self.training_images, self.settings.moving_change)
        self._set_background(self.gaussians.rows(~moves))
        self.gaussians = self.motion.set_off(self.gaussians.rows(moves), self.training_images).trainable()

    def _set_background(self, background: Gaussians) -> None:
        self.background = background
        self.projected = Background(background.splats(), self.training_images.views, self.settings.pixel_filter)

    def sample(self) -> Sample:
        """Return the current step's views and time."""
        training, (index, views) = self.training_images, self._choose(self.stage, self.step)
        tick, images = training.ticks[index], training.measured(index, views)
        if self.corrections:
            images = images + self.corrections.at(index, views)
        return Sample(tick / training.n_ticks, tick, tuple(views), images, self.step, training.exposure_ticks)

    def _choose(self, stage: Stage, step: int) -> tuple[int, list[int]]:
        times, count = self.training_images.images.shape[:2]
        return choose_time(self.settings, stage, step, times), choose_views(self.settings, step, count, self.seed)

    def train_step(self) -> Tensor:
        """Take one step; return the loss."""
        stage = self.stage
        if self.step == stage.first and self.step:
            self._continue(stage)
            self._begin(stage)
        if self.step - stage.first in stage.renewals:
            self._correct_by(self.gaussians.detached())
        sample = self.sample()
        chosen = list(sample.views)
        views = self.poses.views(chosen) if self.settings.refine_poses else self.training_images.views.some(chosen)
        outputs: list[RenderOutput] = []

        def render_at(t: float) -> Tensor:
            splats = self.motion.splats(self.gaussians, stage.within(t)) if stage.deforms else self.gaussians.splats()
            outputs.append(self._image(self._seen(splats, t), chosen, views))
            return self._gray(outputs[-1].image, views, stage, t)

        set_learning_rates(self.adam, self.learning_rates, stage.fraction(self.step))
        self.adam.zero_grad()
        loss = self.supervision(render_at, sample)
        (loss + self.motion.regularizer() + self.coherence(self.gaussians) if stage.deforms else loss).backward()
        self.adam.step()
        self.step += 1
        if self.density.ahead(self.step - stage.first, stage.steps):
            for out in outputs:
                self.statistics.add(out, len(outputs))
        self._adapt_density(stage)
        self._average(stage)
        return loss.detach()

    def _average(self, stage: Stage) -> None:
        """Take the last steps of a stage into the mean of the parameters, which is what the stage ends with."""
        averaged = round(self.settings.average * stage.steps)
        left = stage.first + stage.steps - self.step
        if left < averaged:
            self.averages.add(self.adam, averaged - left)
            if not left:
                self.averages.apply(self.adam)

    def _correct_by(self, snapshot: Gaussians) -> None:
        """Correct values that are means over spans of time by a snapshot of the stage's model from now on."""
        stage, training = self.stage, self.training_images
        # A motion's parameters would go on learning; the snapshot's Gaussians do not.
        if training.spans is None or any(True for _ in self.motion.parameters()):
            return

        fit = proxy(self)  # else a cycle would keep a fit's memory long after its end

        def around(index: int) -> RenderViews:
            def render_views(ticks: float, chosen: Sequence[int]) -> Tensor:
                at, views = (training.ticks[index] + ticks) / training.n_ticks, training.views.some(chosen)
                splats = fit._seen(fit.motion.splats(snapshot, stage.within(at)), at)
                return fit._gray(fit._image(splats, chosen, views).image, views, stage, at)

            return render_views

        self.close()
        self.snapshot, self.corrections = snapshot, Corrections(training.spans, around)
        if snapshot.means.device.type == "cpu":
            self.corrections.begin(self._choose(stage, s) for s in range(self.step, stage.renewed_after(self.step)))

    def close(self) -> None:
        """Stop what works beside the fit's own thread."""
        if self.corrections:
            self.corrections.stop()

    def _seen(self, splats: Splats, t: float) -> Splats:
        """Return splats as they are in the frame of the array at t in [0, 1] of the clip."""
        return self.path.carried(splats, t) if self.path else splats

    def _image(self, splats: Splats, chosen: Sequence[int], views: Views) -> RenderOutput:
        """Render into the chosen views, over the background where there is one."""
        if self.projected:
            return self.projected.render(splats, chosen)
        return render(splats, views, self.settings.pixel_filter)

    def _gray(self, channels: Tensor, views: Views, stage: Stage, t: float) -> Tensor:
        """Return gray radiance [V, H, W] in the light of a time of the clip, from rendered channels [V, H, W, F]."""
        gray = self.motion.image(channels, views) if stage.deforms else channels[..., 0]
        factors = self.training_images.light
        return gray if factors is None else lit(gray, channels, factor_at(factors, t))

    def _adapt_density(self, stage: Stage) -> None:
        s, done, views = self.density, self.step - stage.first, self.training_images.views
        if not s.due(done, stage.steps):
            return
        limit = s.limit(views.width, views.height, background=bool(self.projected))
        rng = seeded(self.seed, self.step)
        for edit in adapt_density(self.gaussians, self.statistics, s, self.scale, limit, rng):
            self.gaussians = apply_edit(self.adam, self.motion.after_densification(edit, rng))
        # Not where the array moves: the motion's Gaussians are in the world's frame, and views in the array's.
        if stage.deforms and not self.path and 2 <= done // s.refine_every < 2 + self.motion.guided_rounds:
            more = self.motion.guided_samples(self.gaussians, self.training_images, rng)
            self.gaussians = apply_edit(self.adam, appended(more, len(self.gaussians)))
        self.coherence.forget()
        self.statistics = GradientStatistics.zero(len(self.gaussians), self.gaussians.means.device)

    def run(
        self, progress: Progress, checkpoint: Path | None = None, fit: str = "", checkpoint_s: float = 15.0
    ) -> None:
        """Train to the end; see `run_steps`. `fit` identifies the fit."""
        with closing(self):
            run_steps(self, progress, checkpoint, fit, checkpoint_s, lambda: f", {len(self.gaussians)} Gaussians")

    def state(self) -> Checkpoint:
        """Return everything that later steps depend on."""
        return Checkpoint.of(
            self.step,
            gaussians=self.gaussians.tensors(),
            background=self.background.tensors(),
            snapshot=self.snapshot.tensors() if self.snapshot else {},
            **{f"piece{i}": g.tensors() for i, g in self.ended.items()},
            motion=self.motion.state_dict(),
            supervision=self.supervision.state_dict(),
            poses=self.poses.state_dict(),
            adam=export_state(self.adam),
            average=self.averages.means,
            coherence=self.coherence.state(),
            statistics={"gradient": self.statistics.gradient, "seen": self.statistics.seen},
        )

    def restore(self, saved: Checkpoint) -> None:
        """Go on from a checkpoint of the same fit."""
        device = self.gaussians.means.device
        self.step = saved.step
        self.gaussians = Gaussians.from_tensors(saved.part("gaussians", device)).trainable()
        background = Gaussians.from_tensors(saved.part("background", device))
        if len(background):
            self._set_background(background)
        for stage in self.plan:
            if ended := saved.part(f"piece{stage.piece}", device):
                self.ended[stage.piece] = Gaussians.from_tensors(ended)
        self.motion.load_state_dict(saved.part("motion"))
        self.supervision.load_state_dict(saved.part("supervision"))
        self.poses.load_state_dict(saved.part("poses"))
        # At a stage's first step the optimiser in the file is the last stage's, and train_step replaces it.
        stage = next(s for s in reversed(self.plan) if s.first < max(self.step, 1))
        self._begin(stage)
        if snapshot := saved.part("snapshot", device):
            self._correct_by(Gaussians.from_tensors(snapshot))
        self.coherence.restore(saved.part("coherence", device))
        import_state(self.adam, saved.part("adam"))
        self.averages.means = saved.part("average", device)
        self.statistics = GradientStatistics(**saved.part("statistics", device))
