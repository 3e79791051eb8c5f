"""The recipes of this package: `METHODS` is what the entry point `spike4dgs.methods` names."""

from __future__ import annotations

from spike4dgs.baselines.nearest_view import NearestView
from spike4dgs.baselines.rig import rig
from spike4dgs.baselines.spike_to_image import IMAGES
from spike4dgs.benchmark.recipes import Method, Recipe
from spike4dgs.method.fit import Parts, RecipeMethod
from spike4dgs.method.motion import MOTIONS
from spike4dgs.method.supervision import SUPERVISIONS

PARTS = Parts(images=IMAGES, initialization={"rig": rig}, motion=MOTIONS, supervision=SUPERVISIONS)

RECIPES = (
    Recipe("tfi+4dgs", images="tfi", initialization="rig", motion="hexplane", supervision="pixel"),
    Recipe("tfp+4dgs", images="tfp", initialization="rig", motion="hexplane", supervision="pixel"),
    # The floor gets as many steps as the deforming recipes have in all, so that only motion makes the difference.
    Recipe(
        "tfp+static",
        images="tfp",
        initialization="rig",
        motion="static",
        supervision="pixel",
        settings={"coarse_steps": 1500},
    ),
)

METHODS: dict[str, Method] = {
    **{recipe.name: RecipeMethod(recipe, PARTS) for recipe in RECIPES},
    "nearest-view": NearestView("nearest-view", IMAGES["tfp"], "tfp"),
}
