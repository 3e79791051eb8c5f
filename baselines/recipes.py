"""The recipes that Spike4DGS is compared with, and the parts that they add to those of `method`.

The rows of the paper's main tables are {tfi, tfp, spk2img} + {d3dgs, stg, 4dgs}, dy-spikegs and dy-spikenerf. Those of
its ablations are named IMAGES + INITIALIZATION + MOTION + SUPERVISION, without `rig` and `pixel`. `METHODS` is what the
entry point `spike4dgs.methods` names.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from spike4dgs.baselines.exposure import Exposure
from spike4dgs.baselines.images.frames import RECORDED
from spike4dgs.baselines.images.published.makers import MAKERS
from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.baselines.nearest_view import NearestView
from spike4dgs.baselines.radiance_field.fit import RADIANCE_FIELD
from spike4dgs.baselines.spacetime import MOTIONS
from spike4dgs.baselines.spike_render import SpikeRender
from spike4dgs.baselines.starts.colmap import ColmapSettings, colmap
from spike4dgs.baselines.starts.dust3r import Dust3rSettings, dust3r
from spike4dgs.baselines.tracking.fit import TRACKING
from spike4dgs.benchmark.method import Method, Recipe
from spike4dgs.benchmark.screen.shown import Table
from spike4dgs.method import recipes as ours
from spike4dgs.method.fit import Parts, RecipeMethod
from spike4dgs.method.recipes import FLAT, MSDI_SETTINGS
from spike4dgs.method.starts.base import Initialization
from spike4dgs.method.tuned import read_tuned, tuned

INITIALIZATIONS = {
    **ours.PARTS.initialization,
    "colmap": Initialization(
        lambda r: colmap(r.scene, r.seed, r.settings), ColmapSettings(), label="poses by COLMAP", estimates_poses=True
    ),
    "dust3r": Initialization(
        lambda r: dust3r(r.scene, r.seed, r.settings, r.device),
        Dust3rSettings(),
        label="poses by DUSt3R",
        estimates_poses=True,
    ),
}
PARTS = Parts(
    images={**IMAGES, **{maker.name: maker for maker in RECORDED}},
    initialization=INITIALIZATIONS,
    motion={**ours.PARTS.motion, **MOTIONS},
    supervision={**ours.PARTS.supervision, "spike-render": SpikeRender, "exposure": Exposure},
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

# The same given what `spike4dgs-x` is given: images and first points corrected by the cameras' calibrations. Spk2ImgNet
# still sees raw spikes; its images are corrected, but for the mean dark rate, which it has learnt to leave out.
# `adaptive` with 4DGS is in `method.recipes`.
CALIBRATED = (
    *(
        Recipe(
            f"{images}+rig-flat+{name}",
            images,
            "rig",
            motion,
            "pixel",
            {**FLAT, **(_SPK2IMG[name] if images == "spk2img" else {})},
        )
        for (name, motion), images in product(_MOTIONS.items(), ("tfi", "tfp", "spk2img"))
    ),
    *(
        Recipe(f"adaptive+rig-flat+{name}", "adaptive", "rig", _MOTIONS[name], "pixel", FLAT)
        for name in ("d3dgs", "stg")
    ),
)

# What other sensors at the same positions give: frames, and frames with events. Nothing of the spikes reaches these.
SENSORS = (
    Recipe("rgb+stg", "rgb", "rig", "spacetime", "pixel"),
    Recipe("rgb+4dgs", "rgb", "rig", "hexplane", "pixel"),
    Recipe("rgb-deblur+stg", "rgb", "rig", "spacetime", "exposure"),
    Recipe("edi+stg", "edi", "rig", "spacetime", "pixel"),
    Recipe("edi+4dgs", "edi", "rig", "hexplane", "pixel"),
)

# Images by networks that other people trained, with their weights.
PUBLISHED = tuple(
    Recipe(f"{maker.name}+{name}", maker.name, "rig", _MOTIONS[name], "pixel", _SPK2IMG[name])
    for name, maker in product(("stg", "4dgs"), MAKERS)
)

# Table 4 from the given poses: only the supervision differs, from tfp+4dgs and from one another.
SUPERVISED = tuple(
    Recipe(f"tfp+4dgs+{name}", "tfp", "rig", "hexplane", name) for name in ("spike", "pixel+spike", "spss")
)

# The initialisations that estimate poses; scored at the calibrated held-out pose and at the refined one. First the rows
# with `--poses estimated`: those of tables 1 and 2 with COLMAP's poses.
_BY_NAME = {recipe.name: recipe for recipe in (*RECIPES, *ours.RECIPES)}
POSED = (
    *(
        replace(_BY_NAME[f"{images}+{name}"], name=f"{images}+colmap+{name}", initialization="colmap")
        for name, images in product(_MOTIONS, ("tfi", "tfp", "spk2img"))
    ),
    *(
        replace(_BY_NAME[name], name=f"{name}+colmap", initialization="colmap")
        for name in ("dy-spikegs", "dy-spikenerf", "spike4dgs", "spike4dgs-x")
    ),
    # Tables 3 and 7.
    Recipe("tfp+dust3r+4dgs", "tfp", "dust3r", "hexplane", "pixel"),
    Recipe("msdi+colmap+4dgs", "msdi", "colmap", "hexplane", "pixel", MSDI_SETTINGS),
    Recipe("msdi+dust3r+4dgs", "msdi", "dust3r", "hexplane", "pixel", MSDI_SETTINGS),
    Recipe("tfi+dust3r+4dgs", "tfi", "dust3r", "hexplane", "pixel"),
    Recipe("tfi+colmap+4dgs+spss", "tfi", "colmap", "hexplane", "spss"),
    Recipe("tfi+dust3r+4dgs+spss", "tfi", "dust3r", "hexplane", "spss"),
)
SEARCHES = read_tuned(Path(__file__).with_name("tuned.json"))
TUNED = tuned((*RECIPES, *CALIBRATED, *PUBLISHED), SEARCHES)
METHODS: dict[str, Method] = Table(
    "methods",
    {
        **{
            recipe.name: RecipeMethod(recipe, PARTS)
            for recipe in (*RECIPES, *CALIBRATED, *SENSORS, *PUBLISHED, *SUPERVISED, *POSED, *TUNED)
        },
        "nearest-view": NearestView("nearest-view", IMAGES["tfp"]),
    },
)
