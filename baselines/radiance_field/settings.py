"""The numbers of the motion `radiance-field`, each with its reason, and the published ones."""

from __future__ import annotations

from dataclasses import dataclass, replace

from spike4dgs.method.settings import Settings
from spike4dgs.method.supervision.spike import Reset

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
    hard_reset: bool = False  # True: as published, biased (see supervision/spike_neuron.py)

    @property
    def reset(self) -> Reset:
        """The effect of a spike on the charge."""
        return "hard" if self.hard_reset else "subtract"
