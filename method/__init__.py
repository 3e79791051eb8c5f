"""Spike4DGS, the reference method: Gaussians, motions, supervisions, MSDI, rasterizers and the shared trainer."""

from typing import TYPE_CHECKING

from spike4dgs.benchmark.lazy import lazy_names

if TYPE_CHECKING:
    from spike4dgs.method.fit import Parts, RecipeMethod
    from spike4dgs.method.models.saved_model import SavedModel, load_model
    from spike4dgs.method.motion.table import MOTIONS
    from spike4dgs.method.supervision.table import SUPERVISIONS
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "fit": ("Parts", "RecipeMethod"),
            "motion.table": ("MOTIONS",),
            "models.saved_model": ("SavedModel", "load_model"),
            "supervision.table": ("SUPERVISIONS",),
        },
    )

__all__ = ["MOTIONS", "SUPERVISIONS", "Parts", "RecipeMethod", "SavedModel", "load_model"]
