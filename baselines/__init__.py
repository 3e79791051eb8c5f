"""The systems that the paper compares with, composed from the parts of `method`."""

from typing import TYPE_CHECKING

from spike4dgs.benchmark.lazy import lazy_names

if TYPE_CHECKING:
    from spike4dgs.baselines.recipes import METHODS
    from spike4dgs.baselines.spike_to_image.table import IMAGES, ImageMaker, make_image
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "recipes": ("METHODS",),
            "spike_to_image.table": ("IMAGES", "ImageMaker", "make_image"),
        },
    )

__all__ = ["IMAGES", "METHODS", "ImageMaker", "make_image"]
