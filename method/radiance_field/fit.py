"""The fitting loop of the motion `radiance-field`: rays of all training views at one time, against recorded spikes.

A step takes random pixels of all views at one time of the clip (the publication: of one image, static scenes), marches
their rays through the coarse and the fine field, lets the spiking layer fire on both radiances, and compares its rates
with the recorded mean spikes, which the recipe's images hold: with `tfp` exactly, in a window around the instant.

Everything random is drawn from generators seeded by (seed, step), as in the trainer of Gaussians: a fit that resumes
gives the bits of one that never stopped (on the CPU).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from spike4dgs.method.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from spike4dgs.method.fit import Algorithm, FitJob
from spike4dgs.method.gaussians.optimizer import Decay, export_state, import_state, make_adam, set_rates
from spike4dgs.method.motion.hexplane import plane_tv, time_smoothness, time_sparsity
from spike4dgs.method.motion.table import hexplane_shape
from spike4dgs.method.radiance_field.march import Rays, camera_rays
from spike4dgs.method.radiance_field.model import DynamicField, FieldShape, RadianceModel, bounds_of
from spike4dgs.method.radiance_field.occupancy import may_move
from spike4dgs.method.schedule import GOLDEN
from spike4dgs.method.settings import TrainSettings
from spike4dgs.method.supervision.spike_neuron import Reset, firing_rate, spike_loss
from spike4dgs.method.trainer import one_torch_thread, seeded

# SpikeNeRF's own values, for synthetic scenes (its rate falls by 0.1^(step / 500,000), its two networks are alike), and
# for the deformation 4DGS's, for the settings of the same name.
PUBLISHED: dict[str, float] = {
    "steps": 200_000,
    "rays": 1024,
    "coarse_samples": 64,
    "fine_samples": 128,
    "depth": 8,
    "width": 256,
    "coarse_depth": 8,
    "coarse_width": 256,
    "position_frequencies": 10,
    "direction_frequencies": 4,
    "field_rate": 5e-4,
    "field_rate_last": 2e-4,
    "spike_steps": 256,
    "features": 16,
    "deformation_width": 128,
    "grid_rate": 1.6e-3,
    "grid_rate_last": 1.6e-4,
    "deformation_rate": 1.6e-4,
    "deformation_rate_last": 1.6e-5,
}

CHANGE = 0.04  # standard deviation over the clip, spikes per tick, of a pixel that changes; windows of 40 give 0.0125


@dataclass(frozen=True)
class RadianceFieldSettings:
    """Hyper-parameters of a fit on 2 cores; `PUBLISHED` holds SpikeNeRF's. `*_last` is reached log-linearly."""

    # Steps. Many small ones: the fine network alone, on one view's pixels, comes to 30.2 dB in 1400 steps of 256 and to
    # 26.4 dB in 700 of 512.
    steps: int = 1100
    rays: int = 256
    coarse_samples: int = 48
    fine_samples: int = 16
    ramp: float = 0.6  # share of the steps in which the times open up from the middle to the whole clip; 0.3: too fast
    first_share: float = 0.2  # middle share of the clip that is seen at first

    # Times at which images are made from the spikes (as TrainSettings).
    time_spacing_ticks: int = 10
    edge_ticks: int = 10
    max_times: int = 256
    flat_field: bool = False  # correct the images by each camera's calibration, if known

    # Networks.
    depth: int = 4
    width: int = 128
    coarse_depth: int = 3
    coarse_width: int = 32  # it only has to say where something is
    position_frequencies: int = 5  # finer ones are noise after so few steps: 8 cost 1.6 dB on car, 6 cost 0.6
    direction_frequencies: int = 4
    field_rate: float = 3e-3  # Adam's; published 5e-4 for 200,000 steps
    field_rate_last: float = 3e-4

    # Deformation: 4DGS's planes, sized as for Gaussians.
    features: int = 8
    deformation_width: int = 32
    # At the Gaussians' rates (1e-2, 1e-3), which see whole images in a step, a moving plane was not followed.
    grid_rate: float = 3e-2
    grid_rate_last: float = 3e-3
    deformation_rate: float = 5e-3
    deformation_rate_last: float = 5e-4
    tv_weight: float = 2e-4
    smooth_weight: float = 1e-3
    sparse_weight: float = 1e-4

    # Spiking layer.
    spike_steps: int = 256
    hard_reset: bool = False  # True: as published, biased (see spiking.py)

    # Occupancy.
    occupancy_cells: int = 48
    occupancy_from: float = 0.2  # share of the steps before the first look: the field knows nothing yet
    occupancy_every: int = 16  # steps between two looks
    occupancy_share: float = 0.15  # of the cells in one look
    occupancy_least: float = 0.02  # opacity of a cell below which it counts as empty

    beta1: float = 0.9
    beta2: float = 0.99

    def scaled(self, scale: float) -> RadianceFieldSettings:
        """The same settings with the step counts multiplied by a budget's scale."""
        return replace(self, steps=max(1, round(self.steps * scale)))

    @property
    def reset(self) -> Reset:
        """What a spike does to the charge."""
        return "hard" if self.hard_reset else "subtract"


class Fitter:
    """A fit in progress."""

    def __init__(self, job: FitJob) -> None:
        self.job, self.settings, self.step = job, job.settings, 0
        s, extent, start = self.settings, job.extent, job.start
        planes = hexplane_shape(extent, TrainSettings(features=s.features, mlp_width=s.deformation_width))
        shape = FieldShape(
            depth=s.depth,
            width=s.width,
            coarse_depth=s.coarse_depth,
            coarse_width=s.coarse_width,
            position_frequencies=s.position_frequencies,
            direction_frequencies=s.direction_frequencies,
            coarse_samples=s.coarse_samples,
            fine_samples=s.fine_samples,
            occupancy_cells=s.occupancy_cells,
            occupancy_least=s.occupancy_least,
            deformation=planes,
        )
        bounds = bounds_of(start.cameras, start.points, extent.low, extent.high, extent.scale)
        gain = job.scene.radiance_gain
        self.field = DynamicField(shape, bounds, 1 / gain, seeded(job.seed, -1)).to(job.device)
        views = [camera_rays(c, job.device) for c in start.cameras]
        self.rays = Rays(torch.cat([r.origins for r in views]), torch.cat([r.directions for r in views]))
        self.recorded = (job.training_images.images * gain).flatten(1)  # [T, C * H * W] mean spikes per tick
        self._begin_grid()
        field, grid, mlp = self.field.parameter_groups()
        self.adam = make_adam({"field": field, "grid": grid, "deformation": mlp}, (s.beta1, s.beta2))
        self.rates = {
            "field": Decay(s.field_rate, s.field_rate_last),
            "grid": Decay(s.grid_rate, s.grid_rate_last),
            "deformation": Decay(s.deformation_rate, s.deformation_rate_last),
        }

    def _begin_grid(self) -> None:
        """Tell the occupancy grid where there are points, and where something may move."""
        start, shape = self.job.start, self.job.training_images.images.shape
        moving = (self.recorded.std(0, correction=0) > CHANGE).view(shape[1:]).cpu().numpy()
        points = torch.as_tensor(start.points, device=self.job.device)
        self.field.occupancy.begin(points, may_move(self.field.occupancy, start.cameras, moving))

    def choose_time(self) -> int:
        """Index of the step's time: the middle of the clip first, and then more and more of it."""
        s, times = self.settings, len(self.job.training_images.ticks)
        opened = min(1.0, self.step / (s.ramp * s.steps)) if s.ramp else 1.0
        share = s.first_share + (1 - s.first_share) * opened
        return min(times - 1, int((0.5 + share * ((self.step * GOLDEN) % 1.0 - 0.5)) * times))

    def loss(self, generator: torch.Generator) -> Tensor:
        """Spike loss of both fields on random rays of one time, and the planes' regulariser."""
        s, job = self.settings, self.job
        index = self.choose_time()
        pixels = torch.randint(len(self.rays), (s.rays,), generator=generator).to(self.recorded.device)
        recorded = self.recorded[index, pixels]
        images = self.field.trace(
            self.rays[pixels], job.training_images.ticks[index] / job.training_images.n_ticks, generator
        )
        start = torch.rand(s.rays, generator=generator).to(recorded) * (not s.hard_reset)  # published: from 0
        rates = [firing_rate(job.scene.radiance_gain * x, start, s.spike_steps, s.reset) for x in images]
        planes = self.field.deformation.planes
        space, times = list(planes.space), list(planes.time)
        smooth = s.smooth_weight * time_smoothness(times) + s.sparse_weight * time_sparsity(times)
        return spike_loss(rates[0], recorded) + spike_loss(rates[1], recorded) + s.tv_weight * plane_tv(space) + smooth

    def train_step(self) -> Tensor:
        """One step; returns the loss."""
        s, generator = self.settings, seeded(self.job.seed, self.step)
        set_rates(self.adam, self.rates, self.step / s.steps)
        self.adam.zero_grad(set_to_none=True)
        loss = self.loss(generator)
        loss.backward()
        self.adam.step()
        self.step += 1
        if self.step % s.occupancy_every == 0 and self.step >= s.occupancy_from * s.steps:
            at = float(torch.rand((), generator=generator))
            self.field.look(at, s.occupancy_share, generator)
        return loss.detach()

    def run(self, checkpoint_s: float = 15.0) -> None:
        """Fit to the end, from the job's checkpoint where it exists; it is written every `checkpoint_s` seconds.

        Raises UserError for a damaged checkpoint or one of another fit.
        """
        job, total = self.job, self.settings.steps
        saved = load_checkpoint(job.checkpoint, job.key) if job.checkpoint else None
        if saved:
            self.restore(saved)
        written = time.monotonic()
        with one_torch_thread():
            while self.step < total:
                loss = self.train_step()
                if job.checkpoint and (time.monotonic() - written >= checkpoint_s or self.step == total):
                    save_checkpoint(job.checkpoint, self.state(), job.key)
                    written = time.monotonic()
                if self.step % 10 == 0 or self.step == total:
                    job.progress(self.step, total, f"loss {loss.item():.4f}")

    def state(self) -> Checkpoint:
        """Everything that later steps depend on."""
        parts = {"field": self.field.state_dict(), "adam": export_state(self.adam)}
        return Checkpoint(self.step, {f"{part}.{k}": v for part, tensors in parts.items() for k, v in tensors.items()})

    def restore(self, saved: Checkpoint) -> None:
        """Go on from a checkpoint of the same fit."""
        self.step = saved.step
        self.field.load_state_dict(saved.part("field"))
        import_state(self.adam, saved.part("adam"))


def fit_radiance_field(job: FitJob) -> RadianceModel:
    """Fit a dynamic radiance field to the job's training images; see the module.

    Raises UserError for a damaged checkpoint or one of another fit.
    """
    fitter = Fitter(job)
    fitter.run()
    return RadianceModel(fitter.field, job.scene.duration_us, job.device)


RADIANCE_FIELD = Algorithm(RadianceFieldSettings(), fit_radiance_field, PUBLISHED, ("spike",))
