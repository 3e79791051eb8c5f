"""What Spike4DGS is compared with: images, starts, motions and recipes of others, fitted by the trainer of `method`."""

from typing import TYPE_CHECKING

from spike4dgs.benchmark.lazy import lazy_names

if TYPE_CHECKING:
    from spike4dgs.baselines.images.table import IMAGES, ImageMaker, make_image
    from spike4dgs.baselines.recipes import METHODS
else:
    __getattr__, __dir__ = lazy_names(
        __name__, {"recipes": ("METHODS",), "images.table": ("IMAGES", "ImageMaker", "make_image")}
    )

__all__ = ["IMAGES", "METHODS", "ImageMaker", "make_image"]
