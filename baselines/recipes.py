"""The recipes of this package: `METHODS` is what the entry point `spike4dgs.methods` names.

The rows of the paper's main tables are {tfi, tfp, spk2img} + {d3dgs, stg, 4dgs}, dy-spikegs and dy-spikenerf. Those of
its ablations, and of ours, are named IMAGES + INITIALIZATION + MOTION + SUPERVISION, without `rig` and `pixel`, and
with one `msdi` for images and points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.baselines.nearest_view import NearestView
from spike4dgs.baselines.radiance_field import RADIANCE_FIELD
from spike4dgs.baselines.starts.colmap import (
    ColmapSettings,
    UncalibratedSettings,
    colmap,
    colmap_uncalibrated,
)
from spike4dgs.baselines.starts.dust3r import Dust3rSettings, dust3r, dust3r_uncalibrated
from spike4dgs.baselines.tracking.fit import TRACKING
from spike4dgs.benchmark.method import GIVEN, Method, Recipe
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.descriptions import describe
from spike4dgs.method.fit import FLAT_FIELD, Parts, RecipeMethod
from spike4dgs.method.held_out_pose import PosedRecipe
from spike4dgs.method.motion.table import MOTIONS
from spike4dgs.method.settings import S
from spike4dgs.method.starts.base import Initialization, Start
from spike4dgs.method.starts.msdi import (
    MsdiMatchedSettings,
    MsdiSettings,
    MsdiUncalibratedSettings,
    msdi,
    msdi_matched,
    msdi_uncalibrated,
)
from spike4dgs.method.starts.rig import RigSettings, rig
from spike4dgs.method.supervision.table import SUPERVISIONS


def _seeded(start: Callable[[TrainingScene, int, S], Start], settings: S) -> Initialization:
    """Return the entry of an initialisation with a seed."""
    return Initialization(lambda r: start(r.scene, r.seed, r.settings), settings)


def _network(start: Callable[[TrainingScene, int, S, str], Start], settings: S) -> Initialization:
    """Return the entry of an initialisation with a seed, by a network, which runs on the fit's device."""
    return Initialization(lambda r: start(r.scene, r.seed, r.settings, r.device), settings)


INITIALIZATIONS = {
    "rig": Initialization(lambda r: rig(r.scene, r.settings), RigSettings()),
    "colmap": _seeded(colmap, ColmapSettings()),
    "colmap-uncalibrated": _seeded(colmap_uncalibrated, UncalibratedSettings()),
    "dust3r": _network(dust3r, Dust3rSettings()),
    "dust3r-uncalibrated": _network(dust3r_uncalibrated, Dust3rSettings()),
    "msdi": Initialization(lambda r: msdi(r.scene, r.settings, r.device), MsdiSettings()),
    "msdi-matched": _network(msdi_matched, MsdiMatchedSettings()),
    "msdi-uncalibrated": _network(msdi_uncalibrated, MsdiUncalibratedSettings()),
}
PARTS = Parts(
    images=IMAGES,
    initialization=INITIALIZATIONS,
    motion=MOTIONS,
    supervision=SUPERVISIONS,
    algorithms={"tracking": TRACKING, "radiance-field": RADIANCE_FIELD},
)
_MOTIONS = {"d3dgs": "tracking", "stg": "spacetime", "4dgs": "hexplane"}

# Spk2ImgNet's images take a quarter of a quick fit's 90 s on two cores, at every other time of the other rows; for it
# STG has a sixth and 4DGS, the slowest, a quarter fewer steps.
_SPK2IMG: dict[str, dict[str, Any]] = {
    "d3dgs": {},
    "stg": {"images.time_spacing_ticks": 20, "trainer.fine_steps": 950},
    "4dgs": {"images.time_spacing_ticks": 20, "trainer.coarse_steps": 250, "trainer.fine_steps": 900},
}

RECIPES = (
    *(
        Recipe(f"{images}+{name}", images, "rig", motion, "pixel", _SPK2IMG[name] if images == "spk2img" else {})
        for (name, motion), images in product(_MOTIONS.items(), ("tfi", "tfp", "spk2img"))
    ),
    Recipe("dy-spikegs", "tfp", "rig", "hexplane", "spike-render"),
    Recipe("dy-spikenerf", "tfp", "rig", "radiance-field", "spike"),
    # The floor gets as many steps as the deforming recipes have in all, so that only motion makes the difference.
    Recipe("tfp+static", "tfp", "rig", "static", "pixel", {"trainer.coarse_steps": 1500}),
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
_MSDI: dict[str, Any] = {
    **_CLEAN,
    "images.flat_field": True,
    "images.time_spacing_ticks": 10,
    "motion.cell_ticks": 64.0,
    "trainer.coarse_steps": 400,
    "trainer.fine_steps": 1300,
}
SPIKE4DGS = (
    Recipe("spike4dgs", "msdi", "msdi", "hexplane", "spss", _MSDI),
    Recipe("msdi+4dgs", "msdi", "msdi", "hexplane", "pixel", _MSDI),
    Recipe("msdi+4dgs+spike", "msdi", "msdi", "hexplane", "spike", _MSDI),
    Recipe("msdi+4dgs+pixel+spike", "msdi", "msdi", "hexplane", "pixel+spike", _MSDI),
)

# Images and first points corrected by the cameras' calibrations: what method names call rig-flat.
_FLAT: dict[str, Any] = {"images.flat_field": True}

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

# Beyond the paper. `spike4dgs-x`: every pixel's rate over the longest window of the clip that constant light explains,
# and where light changes the mean over a known span, which the fit's own model makes an instant; corrected by the
# cameras' calibration; what does not move is fitted first and becomes a background; what moves follows paths of its
# own. The rows before it have a part of that each: the calibration alone, then the windows too.
BEYOND = (
    Recipe("tfp+rig-flat+stg", "tfp", "rig", "spacetime", "pixel", _FLAT),
    Recipe("tfp+rig-flat+4dgs", "tfp", "rig", "hexplane", "pixel", _FLAT),
    Recipe("adaptive+rig-flat+4dgs", "adaptive", "rig", "hexplane", "pixel", _FLAT),
    Recipe(
        "spike4dgs-x",
        "intervals",
        "rig",
        "paths",
        "pixel",
        {
            **_FLAT,
            **_PATHS,
            # Corrected means of a clip have hardly any noise: a road's grain is enough to find its depth.
            "initialization.noise": 3e-5,
            "supervision.ease": 0.02,  # a span's noise, which is off by up to a spike: the median of few is one of them
        },
    ),
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

# Table 4 from the given poses: only the supervision differs, from tfp+4dgs and from one another.
SUPERVISED = tuple(
    Recipe(f"tfp+4dgs+{name}", "tfp", "rig", "hexplane", name) for name in ("spike", "pixel+spike", "spss")
)

# The initialisations that estimate poses; scored at the calibrated held-out pose and at the refined one. First the rows
# with `--poses estimated`: those of tables 1 and 2 with COLMAP's poses, or with those that MSDI's points begin.
_BY_NAME = {recipe.name: recipe for recipe in (*RECIPES, *SPIKE4DGS, *BEYOND)}
POSED = (
    *(
        replace(_BY_NAME[f"{images}+{name}"], name=f"{images}+colmap+{name}", initialization="colmap")
        for name, images in product(_MOTIONS, ("tfi", "tfp", "spk2img"))
    ),
    *(
        replace(_BY_NAME[name], name=f"{name}+colmap", initialization=start)
        for name, start in (
            ("dy-spikegs", "colmap"),
            ("dy-spikenerf", "colmap"),
            ("spike4dgs", "colmap"),
            ("spike4dgs-x", "colmap"),
        )
    ),
    Recipe("spike4dgs-uncalibrated", "msdi", "msdi-matched", "hexplane", "spss", _MSDI),
    # Tables 3 and 7.
    Recipe("tfp+dust3r+4dgs", "tfp", "dust3r", "hexplane", "pixel"),
    # COLMAP saw raw images when this row was published.
    Recipe("msdi+colmap+4dgs", "msdi", "colmap", "hexplane", "pixel", _MSDI | {"initialization.flat_field": False}),
    Recipe("msdi+dust3r+4dgs", "msdi", "dust3r", "hexplane", "pixel", _MSDI),
    Recipe("tfi+dust3r+4dgs", "tfi", "dust3r", "hexplane", "pixel"),
    Recipe("tfi+colmap+4dgs+spss", "tfi", "colmap", "hexplane", "spss"),
    Recipe("tfi+dust3r+4dgs+spss", "tfi", "dust3r", "hexplane", "spss"),
)

# Losses that compare recorded spikes with those of the camera's calibrated response (`supervision.spike_cameras`).
_CALIBRATED_LOSSES = {"spike", "pixel+spike", "spss"}


def _with_given(method: RecipeMethod) -> RecipeMethod:
    """Return a method that says what it is given: by its images, first points and loss, and who estimates the poses."""
    corrected = [getattr(method.settings[part], FLAT_FIELD, False) for part in ("images", "initialization")]
    own_loop = method.recipe.motion in PARTS.algorithms
    calibrated = any(corrected) or method.recipe.initialization.startswith("msdi")
    calibrated |= method.recipe.supervision in _CALIBRATED_LOSSES and not own_loop
    posed = isinstance(method, PosedRecipe)
    method.given = tuple(name for name, used in zip(GIVEN, (not posed, calibrated), strict=True) if used)
    return method


METHODS: dict[str, Method] = {
    **{
        recipe.name: _with_given(RecipeMethod(recipe, PARTS, description=describe(recipe)))
        for recipe in (*RECIPES, *SPIKE4DGS, *BEYOND, SELF_CALIBRATED, *SUPERVISED)
    },
    **{recipe.name: _with_given(PosedRecipe(recipe, PARTS, description=describe(recipe))) for recipe in POSED},
    "nearest-view": NearestView("nearest-view", IMAGES["tfp"], "tfp"),
}
