"""The fitting loop of the motion `radiance-field`: rays of all training views at one time, against recorded spikes.

A step takes random pixels of all views at one time of the clip (the publication: of one image, static scenes), marches
their rays through the coarse and the fine field, lets the spiking layer fire on both radiances, and compares its rates
with the recorded mean spikes, which the recipe's images hold: with `tfp` exactly, in a window around the instant.

Everything random comes from generators seeded by (seed, step), as in the trainer of Gaussians: a fit that resumes
gives the bits of one that never stopped (on the CPU).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from spike4dgs.baselines.radiance_field.march import Rays, camera_rays
from spike4dgs.baselines.radiance_field.model import DynamicField, FieldShape, RadianceModel, bounds_of
from spike4dgs.baselines.radiance_field.occupancy import OccupancySettings, may_move
from spike4dgs.method.checkpoint import Checkpoint, run_steps
from spike4dgs.method.fit import Algorithm, FitJob
from spike4dgs.method.gaussians.optimizer import Adam, Decay, export_state, import_state, set_learning_rates
from spike4dgs.method.images.training import ImageSettings
from spike4dgs.method.motion.hexplane import HexPlaneSettings, hexplane_shape, plane_tv, time_smoothness, time_sparsity
from spike4dgs.method.schedule import GOLDEN
from spike4dgs.method.settings import Settings
from spike4dgs.method.supervision.spike import Reset, firing_rate, spike_loss
from spike4dgs.method.torch_state import seeded
from spike4dgs.method.training_views.changes import RAYS, changing
from spike4dgs.method.training_views.training_images import known

# SpikeNeRF's own values, for synthetic scenes (its learning rate falls by 0.1^(step / 500,000), its two networks are
# alike), and for the deformation 4DGS's, for the settings of the same name.
PUBLISHED: dict[str, float] = {
    "motion.steps": 200_000,
    "motion.rays": 1024,
    "motion.coarse_samples": 64,
    "motion.fine_samples": 128,
    "motion.depth": 8,
    "motion.width": 256,
    "motion.coarse_depth": 8,
    "motion.coarse_width": 256,
    "motion.position_frequencies": 10,
    "motion.direction_frequencies": 4,
    "motion.lr_field": 5e-4,
    "motion.lr_field_last": 2e-4,
    "motion.features": 16,
    "motion.deformation_width": 128,
    "motion.lr_grid": 1.6e-3,
    "motion.lr_grid_last": 1.6e-4,
    "motion.lr_deformation": 1.6e-4,
    "motion.lr_deformation_last": 1.6e-5,
    "supervision.neuron_ticks": 256,
}
FURTHER = 2 / 3  # of the steps, for each further 20 ms of a clip: the share that others' `piece_steps` are


@dataclass(frozen=True)
class RadianceFieldSettings(Settings):
    """Steps, networks and learning rates of a fit on 2 cores (prefix `motion`); `PUBLISHED` holds SpikeNeRF's."""

    # Steps. Many small ones: the fine network alone, on one view's pixels, comes to 30.2 dB in 1400 steps of 256 and to
    # 26.4 dB in 700 of 512.
    steps: int = 1100
    rays: int = 256
    coarse_samples: int = 48
    fine_samples: int = 16
    ramp: float = 0.6  # share of the steps in which the times open up from the middle to the whole clip; 0.3: too fast
    first_share: float = 0.2  # middle share of the clip that is seen at first

    # Networks.
    depth: int = 4
    width: int = 128
    coarse_depth: int = 3
    coarse_width: int = 32  # it only has to say where something is
    position_frequencies: int = 5  # finer ones are noise after so few steps: 8 cost 1.6 dB on car, 6 cost 0.6
    direction_frequencies: int = 4
    lr_field: float = 3e-3  # published 5e-4 for 200,000 steps
    lr_field_last: float = 3e-4

    # Deformation: 4DGS's planes, sized as for Gaussians.
    features: int = 8
    deformation_width: int = 32
    # At the Gaussians' learning rates (1e-2, 1e-3), which see whole images in a step, a moving plane was not followed.
    lr_grid: float = 3e-2
    lr_grid_last: float = 3e-3
    lr_deformation: float = 5e-3
    lr_deformation_last: float = 5e-4
    tv_weight: float = 2e-4
    smooth_weight: float = 1e-3
    sparse_weight: float = 1e-4

    beta1: float = 0.9
    beta2: float = 0.99

    def scaled(self, scale: float) -> RadianceFieldSettings:
        """Return the same settings with the step counts multiplied by a budget's scale."""
        return replace(self, steps=max(1, round(self.steps * scale)))


@dataclass(frozen=True)
class FieldSpikeSettings(Settings):
    """The spiking layer behind the field (prefix `supervision`)."""

    neuron_ticks: int = 256  # for which a neuron sees a rendered ray
    hard_reset: bool = False  # True: as published, biased (see `supervision/spike.py`)

    @property
    def reset(self) -> Reset:
        """The effect of a spike on the charge."""
        return "hard" if self.hard_reset else "subtract"


class Fitter:
    """A fit in progress."""

    def __init__(self, job: FitJob) -> None:
        self.job, self.settings = job, job.settings["motion"].scaled(1 + (job.parts - 1) * FURTHER)
        self.step, self.total = 0, self.settings.steps
        self.spiking, self.occupancy = job.settings["supervision"], job.settings["occupancy"]
        s, extent, start, request = self.settings, job.extent, job.start, job.request
        planes = hexplane_shape(extent, HexPlaneSettings(features=s.features, mlp_width=s.deformation_width))
        shape = FieldShape(
            depth=s.depth,
            width=s.width,
            coarse_depth=s.coarse_depth,
            coarse_width=s.coarse_width,
            position_frequencies=s.position_frequencies,
            direction_frequencies=s.direction_frequencies,
            coarse_samples=s.coarse_samples,
            fine_samples=s.fine_samples,
            occupancy_cells=self.occupancy.cells,
            occupancy_least=self.occupancy.least,
            deformation=planes,
        )
        bounds = bounds_of(start.cameras, start.points, extent.low, extent.high, extent.scale)
        generator = seeded(request.seed, -1)
        self.field = DynamicField(shape, bounds, 1 / job.scene.radiance_gain, generator).to(request.device)
        views = [camera_rays(c, request.device) for c in start.cameras]
        self.rays = Rays(torch.cat([r.origins for r in views]), torch.cat([r.directions for r in views]))
        self._begin_grid()
        field, grid, mlp = self.field.parameter_groups()
        self.adam = Adam({"field": field, "grid": grid, "deformation": mlp}, (s.beta1, s.beta2))
        self.learning_rates = {
            "field": Decay(s.lr_field, s.lr_field_last),
            "grid": Decay(s.lr_grid, s.lr_grid_last),
            "deformation": Decay(s.lr_deformation, s.lr_deformation_last),
        }

    def _begin_grid(self) -> None:
        """Tell the occupancy grid where there are points, and where something may move."""
        start = self.job.start
        recorded = self.job.training_images.images * self.job.scene.radiance_gain  # [T, C, H, W] mean spikes per tick
        moving = changing(recorded, RAYS).cpu().numpy()
        points = torch.as_tensor(start.points, device=self.job.request.device)
        self.field.occupancy.begin(points, may_move(self.field.occupancy, start.cameras, moving))

    def choose_time(self) -> int:
        """Return the index of the step's time: the middle of the clip first, and then more and more of it."""
        s, times = self.settings, len(self.job.training_images.ticks)
        opened = min(1.0, self.step / (s.ramp * s.steps)) if s.ramp else 1.0
        share = s.first_share + (1 - s.first_share) * opened
        return min(times - 1, int((0.5 + share * ((self.step * GOLDEN) % 1.0 - 0.5)) * times))

    def loss(self, generator: torch.Generator) -> Tensor:
        """Return the spike loss of both fields on random rays of one time, and the planes' regulariser."""
        s, spiking, job = self.settings, self.spiking, self.job
        index = self.choose_time()
        pixels = torch.randint(len(self.rays), (s.rays,), generator=generator).to(job.training_images.images.device)
        recorded = job.training_images.measured(index).flatten()[pixels] * job.scene.radiance_gain
        images = self.field.trace(
            self.rays[pixels], job.training_images.ticks[index] / job.training_images.n_ticks, generator
        )
        start = torch.rand(s.rays, generator=generator).to(recorded) * (not spiking.hard_reset)  # published: from 0
        rates = [firing_rate(job.scene.radiance_gain * x, start, spiking.neuron_ticks, spiking.reset) for x in images]
        planes = self.field.deformation.planes
        space, times = list(planes.space), list(planes.time)
        smooth = s.smooth_weight * time_smoothness(times) + s.sparse_weight * time_sparsity(times)
        loss = spike_loss(rates[0], known(recorded, rates[0])) + spike_loss(rates[1], known(recorded, rates[1]))
        return loss + s.tv_weight * plane_tv(space) + smooth

    def train_step(self) -> Tensor:
        """Take one step; return the loss."""
        s, grid, generator = self.settings, self.occupancy, seeded(self.job.request.seed, self.step)
        set_learning_rates(self.adam, self.learning_rates, self.step / s.steps)
        self.adam.zero_grad()
        loss = self.loss(generator)
        loss.backward()
        self.adam.step()
        self.step += 1
        if self.step % grid.every == 0 and self.step >= grid.begin * s.steps:
            at = float(torch.rand((), generator=generator))
            self.field.update_occupancy(at, grid.share, generator)
        return loss.detach()

    def run(self, checkpoint_s: float = 15.0) -> None:
        """Fit to the end; see `run_steps`."""
        run_steps(self, self.job.request.progress, self.job.request.checkpoint, self.job.key, checkpoint_s)

    def state(self) -> Checkpoint:
        """Return everything that later steps depend on."""
        return Checkpoint.of(self.step, field=self.field.state_dict(), adam=export_state(self.adam))

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
    return RadianceModel(fitter.field, job.scene.duration_us, job.request.device, tuple(job.start.cameras))


SETTINGS = {
    "images": ImageSettings(),
    "motion": RadianceFieldSettings(),
    "supervision": FieldSpikeSettings(),
    "occupancy": OccupancySettings(),
}
RADIANCE_FIELD = Algorithm(
    "a deforming radiance field", SETTINGS, fit_radiance_field, PUBLISHED, ("spike",), rasterizes=False, refines=False
)
