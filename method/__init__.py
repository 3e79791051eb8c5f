"""Spike4DGS and spike4dgs-x, whole: images, starts, motions, supervisions, rasterizers, trainer, viewer and recipes."""

from typing import TYPE_CHECKING

from spike4dgs.benchmark.lazy import lazy_names

if TYPE_CHECKING:
    from spike4dgs.method.fit import Parts, RecipeMethod
    from spike4dgs.method.models.saved_model import SavedModel, load_model
    from spike4dgs.method.motion.table import MOTIONS
    from spike4dgs.method.recipes import METHODS
    from spike4dgs.method.supervision.table import SUPERVISIONS
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "fit": ("Parts", "RecipeMethod"),
            "motion.table": ("MOTIONS",),
            "models.saved_model": ("SavedModel", "load_model"),
            "recipes": ("METHODS",),
            "supervision.table": ("SUPERVISIONS",),
        },
    )

__all__ = ["METHODS", "MOTIONS", "SUPERVISIONS", "Parts", "RecipeMethod", "SavedModel", "load_model"]
