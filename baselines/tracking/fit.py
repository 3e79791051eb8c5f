"""Dynamic 3D Gaussians (Luiten et al. 2024), the motion `tracking`: one time after another, each from the last.

At the first time all Gaussians are optimised and densified by the one trainer. Then sizes and opacities are fixed.
At each further time the moving ones go on with the velocity that they had, x + (x - x') and likewise the rotations,
and are optimised against that time's images for a few steps of a fresh Adam, with the terms of `losses`:

    1.0 image + 3.0 silhouette + 4.0 rigidity + 4.0 rotation + 2.0 isometry + 20 background + 0.01 colour,
    image = 0.8 mean |I - P| + 0.2 (1 - SSIM(I, P))

Differences from the publication, and why:

- The first time is the middle of the clip and tracking goes outward both ways (`start` 0 is the published order): the
  initialisation knows moving things best there, and half as many steps add up their errors.
- Its masks are of each instant, ours of all pixels that a thing passes: they forbid moving ones where nothing moves.
- Gaussians of the background are fixed, the limit of an infinite background weight, and only the part of the
  images in which something moves is rendered again. `freeze_background` False gives the published soft term.
- A Gaussian that nothing holds would fly on for ever with its velocity. One that has come to where nothing ever moves
  stays where it was at the time before.
- Lengths are relative to the Gaussians' spacing (`losses`), learning rates fall within each time, and there are no
  terms for exposure (the array is calibrated) and for a floor.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from spike4dgs.baselines.tracking.losses import (
    background_term,
    color_term,
    find_neighbours,
    physical_loss,
    remember,
    unit_quaternions,
)
from spike4dgs.baselines.tracking.model import TrackedModel, Tracks
from spike4dgs.baselines.tracking.silhouettes import silhouettes
from spike4dgs.benchmark.errors import problem
from spike4dgs.method.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from spike4dgs.method.fit import Algorithm, FitJob
from spike4dgs.method.gaussians.density import DensitySettings
from spike4dgs.method.gaussians.optimizer import Adam, Decay, set_learning_rates
from spike4dgs.method.gaussians.parameters import Gaussians, from_points
from spike4dgs.method.images.training import ImageSettings
from spike4dgs.method.motion.table import Static
from spike4dgs.method.schedule import TrainerSettings
from spike4dgs.method.settings import Settings
from spike4dgs.method.splat import Splats, render
from spike4dgs.method.supervision.base import difference
from spike4dgs.method.supervision.pixel import Pixel, PixelSettings
from spike4dgs.method.torch_state import one_torch_thread, seeded
from spike4dgs.method.trainer import Trainer
from spike4dgs.method.training_views.foreground import foreground_points, moving_window, stray_points


@dataclass(frozen=True)
class TrackingSettings(Settings):
    """Steps, loss and learning rates (prefix `motion`). One step renders several views at one time.

    The published 10,000 and 2,000 steps of one image are 200,000 images for a clip of 100 times. Here a fit has the
    time of 4DGS: things move by about a pixel between two times, and a few steps follow that. At the first time the
    trainer's and the density's defaults hold.
    """

    first_steps: int = 400
    later_steps: int = 40  # at each further time
    first_move: float = 3.0  # x later_steps at the second time, whose velocity is not known yet
    views_per_step: int = 4

    start: float = 0.5  # where in the clip the first time is: 0 at its beginning, as published, 1 at its end
    clean_background: bool = True  # pixels that never change show their mean over the clip, without the spikes' noise
    margin_px: int = 8  # around what moves, more than half a window of SSIM

    # Loss; the weights are the publication's.
    image_weight: float = 1.0
    silhouette_weight: float = 3.0
    rigidity_weight: float = 4.0
    rotation_weight: float = 4.0
    isometry_weight: float = 2.0
    background_weight: float = 20.0
    color_weight: float = 0.01
    neighbours: int = 20
    freeze_background: bool = True

    # Adam at the further times, from the first to the last step of each; the publication's are constant.
    lr_means: float = 1.2e-3  # x scene scale (1.6e-4 in 2,000 steps)
    lr_means_last: float = 4e-5
    lr_quats: float = 2e-3  # (1e-3)
    lr_colors: float = 2.5e-3  # as published; slower, colours follow wheels and highlights too late
    lr_colors_last: float = 5e-4
    beta1: float = 0.9
    beta2: float = 0.99  # (0.999, which would average over far more steps than a time has)

    def __post_init__(self) -> None:
        if self.neighbours < 1:
            raise problem("neighbours", "at least 1", str(self.neighbours), "choose another number")

    def scaled(self, scale: float) -> TrackingSettings:
        """Return the same settings with the step counts multiplied by a budget's scale."""
        first, later = (max(1, round(steps * scale)) for steps in (self.first_steps, self.later_steps))
        return replace(self, first_steps=first, later_steps=later)


PUBLISHED = {"motion.first_steps": 2500, "motion.later_steps": 500}  # 10,000 and 2,000 single images in steps of four


@dataclass(frozen=True)
class Visit:
    """A time to track, by its index, from the time before, with the velocity since an earlier one."""

    index: int
    before: int
    earlier: int | None


def visits(first: int, times: int) -> list[Visit]:
    """Return the visits from `first` to the last time, then from `first` back to time 0."""
    forward = [Visit(i, i - 1, i - 2 if i - 2 >= first else None) for i in range(first + 1, times)]
    backward = [Visit(i, i + 1, i + 2 if i + 2 < times else None) for i in range(first - 1, -1, -1)]
    return forward + backward


def fit_tracking(job: FitJob, checkpoint_s: float = 15.0) -> TrackedModel:
    """Fit Dynamic 3D Gaussians, from the job's checkpoint where it exists.

    It is written every `checkpoint_s` seconds once the first time is fitted: a fit that ends before starts anew. A
    resumed fit gives the bits of one that never stopped (on the CPU). Raises UserError for a damaged checkpoint or
    one of another fit.
    """
    checkpoint, device = job.request.checkpoint, job.request.device
    saved = load_checkpoint(checkpoint, job.key) if checkpoint else None
    masks = silhouettes(job)
    if job.settings["motion"].clean_background:
        images = job.training_images.images
        clean = torch.where(masks, images, images.mean(0))
        job = replace(job, training_images=replace(job.training_images, images=clean))
    if saved:
        gaussians = Gaussians.from_tensors({k: v.to(device) for k, v in saved.part("gaussians").items()})
    else:
        gaussians = fit_first(job)
    tracker = Tracker(job, gaussians, masks)
    if saved:
        tracker.restore(saved)
    with one_torch_thread():
        tracker.run(checkpoint_s)
    light = torch.tensor(job.light.factors, dtype=torch.float32) if job.light else None
    return TrackedModel(gaussians, tracker.tracks, job.scene.duration_us, tuple(job.start.cameras), light)


def first_index(job: FitJob) -> int:
    """Return the index of the time that everything starts from: of those that most views have measured, the nearest."""
    images = job.training_images
    last = len(images.ticks) - 1
    lacking = [0] * (last + 1) if images.missing is None else images.missing.sum(1).tolist()
    return min(range(last + 1), key=lambda i: (lacking[i], abs(i - round(job.settings["motion"].start * last))))


def step_count(settings: TrackingSettings, visit: Visit) -> int:
    """Return the steps of one further time, at least one."""
    return max(1, round(settings.later_steps * (settings.first_move if visit.earlier is None else 1)))


def fit_first(job: FitJob) -> Gaussians:
    """Optimise and densify Gaussians at the first time, with the one trainer as for a static scene; return them."""
    s, images, i, request = job.settings["motion"], job.training_images, first_index(job), job.request
    settings = TrainerSettings(coarse_steps=s.first_steps, views_per_step=s.views_per_step)
    motion = Static(job.extent, Static.defaults, seeded(request.seed, -1))
    loss = Pixel(job.settings["supervision"], job.scene)
    start = from_points(job.start.points, job.start.values, opacity=settings.initial_opacity, device=request.device)
    scale = job.extent.scale
    trainer = Trainer(images.at(i), start, motion, loss, settings, DensitySettings(), scale=scale, seed=request.seed)
    total = s.first_steps + sum(step_count(s, visit) for visit in visits(i, len(images.ticks)))
    trainer.run(lambda done, _, note="": request.progress(done, total, note))
    return trainer.gaussians.detached()


class Tracker:
    """The further times. Everything random follows from (seed, time, step), as in the trainer."""

    def __init__(self, job: FitJob, gaussians: Gaussians, masks: Tensor) -> None:
        self.job, self.gaussians, self.settings = job, gaussians, job.settings["motion"]
        training_images = job.training_images
        self.window = moving_window(training_images.views, masks, self.settings.margin_px)
        self.masks = masks
        measured = torch.stack([training_images.measured(i) for i in range(len(training_images.ticks))])
        self.images, self.quiet = self.window.cut(measured), ~self.window.cut(masks)
        moving = foreground_points(gaussians.means, training_images.views, masks)
        with torch.no_grad():
            seen = render(gaussians.splats(), self.window.views).visible.any(0)
        # The moving Gaussians come first, then what else the window shows.
        rows = [torch.nonzero(m)[:, 0] for m in (moving, seen & ~moving)]
        self.count, self.rows = len(rows[0]), torch.cat(rows)
        free = self.rows[: self.count] if self.settings.freeze_background else self.rows
        self.tracks = Tracks.start(gaussians, free, self.rows, training_images.ticks, job.scene.rate_hz)
        self.plan = visits(first_index(job), len(training_images.ticks)) if self.count > 1 else []
        self.done = 0
        self.local = gaussians.rows(self.rows)
        self.flag = torch.zeros(len(self.rows), 1, device=job.request.device)
        self.flag[: self.count] = 1
        area = self.window.views.width * self.window.views.height
        self.share = area / (training_images.views.width * training_images.views.height)

    def run(self, checkpoint_s: float) -> None:
        """Track the times that are left."""
        job, request, steps = self.job, self.job.request, [step_count(self.settings, v) for v in self.plan]
        total, written = self.settings.first_steps + sum(steps), time.monotonic()
        if self.plan:
            self.graph = find_neighbours(self.local.means[: self.count], self.settings.neighbours)
        while True:
            due = time.monotonic() - written >= checkpoint_s or self.done in (0, len(self.plan))
            if request.checkpoint and due:
                save_checkpoint(request.checkpoint, self.state(), job.key)
                written = time.monotonic()
            if self.done == len(self.plan):
                return
            loss = self.track(self.plan[self.done])
            self.done += 1
            note = f"time {self.done + 1} of {len(self.plan) + 1}, loss {loss:.4f}, {self.count} moving Gaussians"
            request.progress(self.settings.first_steps + sum(steps[: self.done]), total, note)

    def track(self, visit: Visit) -> float:
        """Optimise one time; return the last loss."""
        s, tracks, index, scale = self.settings, self.tracks, visit.index, self.job.extent.scale
        old = tracks.at(visit.before)
        leaves = {name: value.clone() for name, value in old.items()}
        if visit.earlier is not None:
            past = tracks.at(visit.earlier)
            leaves["means"] += old["means"] - past["means"]
            leaves["quats"] = unit_quaternions(2 * old["quats"] - past["quats"])
        for leaf in leaves.values():
            leaf.requires_grad_(True)
        loss_of = self.loss(index, old)
        adam = Adam({name: [leaf] for name, leaf in leaves.items()}, (s.beta1, s.beta2))
        rates = {
            "means": Decay(s.lr_means * scale, s.lr_means_last * scale),
            "quats": Decay(s.lr_quats, s.lr_quats),
            "colors": Decay(s.lr_colors, s.lr_colors_last),
        }
        steps = step_count(s, visit)
        for step in range(steps):
            set_learning_rates(adam, rates, step / steps)
            adam.zero_grad()
            generator = seeded(self.job.request.seed, (index + 1) * 1_000_000 + step)
            order = torch.randperm(len(self.window.views), generator=generator)
            loss = loss_of(leaves, order[: s.views_per_step].sort().values.tolist())
            loss.backward()
            adam.step()
        found = {name: leaf.detach() for name, leaf in leaves.items()}
        stray = stray_points(found["means"][: self.count], self.job.training_images.views, self.masks)
        for name in ("means", "quats"):
            found[name][: self.count][stray] = old[name][: self.count][stray]
        tracks.put(index, found)
        return float(loss.detach())

    def loss(self, index: int, old: dict[str, Tensor]) -> Callable[[dict[str, Tensor], list[int]], Tensor]:
        """Return the loss at a time, of free parameters and views to render; `old` are those of the time before."""
        s, n, local, every = self.settings, self.count, self.local, self.window.views
        before = remember(self.graph, old["means"][:n], old["quats"][:n])
        scales, opacities = local.log_scales.exp(), local.logits.sigmoid()
        pixel = self.job.settings["supervision"]
        weights = (s.rigidity_weight, s.rotation_weight, s.isometry_weight)
        free = len(old["means"])

        def loss(leaves: dict[str, Tensor], chosen: list[int]) -> Tensor:
            means, quats = leaves["means"], leaves["quats"]
            everything = torch.cat([means, local.means[free:]]), torch.cat([quats, local.quats[free:]])
            splats = Splats(*everything, scales, opacities, torch.cat([leaves["colors"], self.flag], 1))
            image, silhouette = render(splats, every.some(chosen)).image.unbind(-1)
            total = s.image_weight * difference(image, self.images[index][chosen], pixel.ssim_weight, pixel.huber_delta)
            total = total + s.silhouette_weight * (silhouette * self.quiet[chosen]).mean()
            # A mean over whole images, as published: outside of the window nothing changes.
            total = self.share * total + physical_loss(self.graph, before, means[:n], quats[:n], weights)
            if not s.freeze_background:
                rest = (means[n:], quats[n:], local.means[n:], local.quats[n:], self.graph.unit)
                total = total + s.background_weight * background_term(*rest)
            return total + s.color_weight * color_term(leaves["colors"], old["colors"])

        return loss

    def state(self) -> Checkpoint:
        """Return everything that later times depend on."""
        return Checkpoint.of(self.done, gaussians=self.gaussians.tensors(), tracks=self.tracks.tensors())

    def restore(self, saved: Checkpoint) -> None:
        """Go on from a checkpoint of the same fit."""
        self.done = saved.step
        self.tracks.load(saved.part("tracks"))


SETTINGS = {
    # Every 0.8 ms at 20 kHz; between times everything is interpolated. The most times bound the time of a fit.
    "images": ImageSettings(time_spacing_ticks=16, max_times=40),
    "motion": TrackingSettings(),
    "supervision": PixelSettings(),
}
TRACKING = Algorithm("Dynamic 3D Gaussians", SETTINGS, fit_tracking, PUBLISHED, ("pixel",))
