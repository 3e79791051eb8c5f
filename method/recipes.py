"""Spike4DGS, spike4dgs-x, and what they are made of: `METHODS` is what the entry point `spike4dgs.methods` names.

Ablations are named IMAGES + INITIALIZATION + MOTION + SUPERVISION, without `rig` and `pixel`, and with one `msdi` for
images and points.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from spike4dgs.benchmark.method import Method, Recipe
from spike4dgs.benchmark.screen.shown import Table
from spike4dgs.method.fit import Parts, RecipeMethod
from spike4dgs.method.image_network.maker import MSDI
from spike4dgs.method.images.adaptive import ADAPTIVE
from spike4dgs.method.images.intervals import INTERVALS
from spike4dgs.method.matching.weights import WEIGHTS as MATCHER
from spike4dgs.method.motion.table import MOTIONS
from spike4dgs.method.msdi.weights import WEIGHTS as POINTS
from spike4dgs.method.starts.base import Initialization
from spike4dgs.method.starts.matching import MatchedSettings, matched
from spike4dgs.method.starts.msdi import MsdiSettings, msdi
from spike4dgs.method.starts.rig import RigSettings, rig
from spike4dgs.method.supervision.table import SUPERVISIONS
from spike4dgs.method.tuned import read_tuned, tuned

PARTS = Parts(
    images={maker.name: maker for maker in (ADAPTIVE, INTERVALS, MSDI)},
    initialization={
        "rig": Initialization(
            lambda r: rig(r.scene, r.settings, r.recorded), RigSettings(), label="", from_recorded=True
        ),
        "msdi": Initialization(
            lambda r: msdi(r.scene, r.settings, r.device),
            MsdiSettings(),
            label="matches between views, MSDI's points in gaps",
            calibrated=True,
            networks=(POINTS,),
        ),
        "matched": Initialization(
            lambda r: matched(r.scene, r.seed, r.settings, r.device),
            MatchedSettings(),
            label="poses by the matching network and features",
            estimates_poses=True,
            calibrated=True,
            networks=(MATCHER, POINTS),
        ),
    },
    motion=MOTIONS,
    supervision=SUPERVISIONS,
)

# For images with little noise: a pixel's own filter, first Gaussians half as wide, and many steps of two views, whose
# last parameters are averaged.
_CLEAN: dict[str, Any] = {
    "trainer.filter_variance": 1 / 12,
    "trainer.filter_compensated": True,
    "trainer.initial_scale": 0.5,
    "trainer.views_per_step": 2,
    "trainer.average": 0.2,
}

# The reference method, and with less of it. MSDI's images take about a third of a quick fit's 90 s; half as many would
# cost 2.7 dB on the turntable (1150 steps, `adaptive` images). HexPlane's cells of 16 ticks would fit noise.
MSDI_SETTINGS: dict[str, Any] = {
    **_CLEAN,
    "images.flat_field": True,
    "images.time_spacing_ticks": 10,
    "motion.cell_ticks": 64.0,
    "trainer.coarse_steps": 400,
    "trainer.fine_steps": 1300,
}
SPIKE4DGS = (
    Recipe("spike4dgs", "msdi", "msdi", "hexplane", "spss", MSDI_SETTINGS),
    Recipe("msdi+4dgs", "msdi", "msdi", "hexplane", "pixel", MSDI_SETTINGS),
    Recipe("msdi+4dgs+spike", "msdi", "msdi", "hexplane", "spike", MSDI_SETTINGS),
    Recipe("msdi+4dgs+pixel+spike", "msdi", "msdi", "hexplane", "pixel+spike", MSDI_SETTINGS),
    Recipe("spike4dgs-uncalibrated", "msdi", "matched", "hexplane", "spss", MSDI_SETTINGS),
)

# Images and first points corrected by the cameras' calibrations: what method names call rig-flat.
FLAT: dict[str, Any] = {"images.flat_field": True}

# Customary learning rates are for 30,000 steps. In a thousand, three to seven times as much, falling to a tenth, goes
# as far as four times the steps do. Adam's second moment then has to forget as fast: over 20 steps, not over 100. When
# a Gaussian is there and for how long hardly needs to be learned where paths last as long as the clip.
_FAST: dict[str, Any] = {
    "trainer.lr_means": 1.2e-3,
    "trainer.lr_means_last": 6e-5,
    "trainer.lr_scales": 0.03,
    "trainer.lr_quats": 6e-3,
    "trainer.lr_opacities": 0.1,
    "trainer.lr_colors": 0.015,
    "trainer.lr_last": 0.1,
    "trainer.beta1": 0.85,
    "trainer.beta2": 0.95,
    "motion.lr_coefficients": 7e-3,
    "motion.lr_coefficients_last": 2e-4,
    "motion.lr_times": 1e-4,
    "motion.lr_temporal_scales": 0.01,
}

# What `spike4dgs-x` takes with and without calibrations.
_PATHS: dict[str, Any] = {
    **_CLEAN,
    **_FAST,
    "images.max_times": 100,  # of a clip of 100 ms: twice as many make its fit no better
    "trainer.freeze_background": True,
    "trainer.moving_change": 0.012,
    "trainer.coarse_steps": 500,
    "trainer.fine_steps": 1200,
    "trainer.piece_steps": 400,  # as motion begins with the neighbouring piece's
    "density.max_moving_per_pixel": 0.5,
    "density.max_gaussians": 36_000,
}

# Beyond the paper: every pixel's rate over the longest window of the clip that constant light explains, and where light
# changes the mean over a known span, which the fit's own model makes an instant; corrected by the cameras' calibration;
# what does not move is fitted first and becomes a background; what moves follows paths of its own.
SPIKE4DGS_X = Recipe(
    "spike4dgs-x",
    "intervals",
    "rig",
    "paths",
    "pixel",
    {
        **FLAT,
        **_PATHS,
        # Corrected means of a clip have hardly any noise: a road's grain is enough to find its depth.
        "initialization.noise": 3e-5,
        "initialization.follow_array": True,
        "supervision.huber_delta": 0.02,  # a span's noise, off by up to a spike: the median of few is one of them
    },
)
# The same without the calibrations: it estimates the cameras' fixed patterns from the clip, beside the scene. Its first
# points come from images with these patterns in them; of a still scene it has to learn the patterns as well.
SELF_CALIBRATED = Recipe(
    "spike4dgs-x+self-calibrated",
    "intervals",
    "rig",
    "paths",
    "fixed-pattern",
    {**_PATHS, "initialization.noise": 1e-4, "trainer.coarse_steps": 800, "motion.coherence": 0.005},
)

SEARCHES = read_tuned(Path(__file__).with_name("tuned.json"))
_AS_THEY_ARE = (
    *SPIKE4DGS,
    Recipe("adaptive+rig-flat+4dgs", "adaptive", "rig", "hexplane", "pixel", FLAT),
    SPIKE4DGS_X,
    SELF_CALIBRATED,
)
RECIPES = (*_AS_THEY_ARE, *tuned(_AS_THEY_ARE, SEARCHES))
_DESCRIPTIONS = {
    "spike4dgs": "the paper's method: MSDI's points and images, 4DGS, SPSS",
    "spike4dgs-x": "our own design: means over known spans of time, a fixed background, and paths of what moves",
}
METHODS: dict[str, Method] = Table(
    "methods", {r.name: RecipeMethod(r, PARTS, _DESCRIPTIONS.get(r.name, "")) for r in RECIPES}
)
