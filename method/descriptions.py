"""One line about each recipe, put together from its parts; a part without words here is shown by its name."""

from __future__ import annotations

from spike4dgs.benchmark.method import Recipe

_OWN = {
    "spike4dgs": "the paper's method: MSDI's points and images, 4DGS, SPSS",
    "spike4dgs-x": "our own design: means over known spans of time, a fixed background, and paths of what moves",
}
_MOTION = {
    "static": "3DGS, nothing moves",
    "hexplane": "4DGS",
    "spacetime": "spacetime Gaussians",
    "tracking": "Dynamic 3D Gaussians",
    "paths": "Gaussians on paths before a fixed background",
    "radiance-field": "a deforming radiance field",
}
_IMAGES = {
    "tfi": "from spike intervals",
    "tfp": "from spike counts",
    "spk2img": "by Spk2ImgNet",
    "adaptive": "from the longest windows of constant light",
    "intervals": "from the longest windows of constant light, and known spans where light changes",
    "msdi": "by MSDI",
}
_SUPERVISION = {
    "pixel": "",
    "fixed-pattern": "the cameras' fixed patterns estimated from the clip",
    "spike": "SpikeNeRF's loss",
    "spike-render": "SpikeGS's loss",
    "pixel+spike": "pixel loss and SpikeNeRF's",
    "spss": "SPSS",
}
_INITIALIZATION = {
    "rig": "",
    "colmap": "poses by COLMAP",
    "dust3r": "poses by DUSt3R",
    "msdi": "points by MSDI",
    "msdi-matched": "poses by MSDI and matching",
}


def describe(recipe: Recipe) -> str:
    """Return one line that says what a recipe is."""
    if recipe.name in _OWN:
        return _OWN[recipe.name]
    flat = recipe.settings.get("images.flat_field") and recipe.images != "msdi"
    images = f"images {_words(_IMAGES, recipe.images)}" + (", corrected by calibration" if flat else "")
    rest = (images, _words(_SUPERVISION, recipe.supervision), _words(_INITIALIZATION, recipe.initialization))
    return "; ".join((_words(_MOTION, recipe.motion), *filter(None, rest)))


def _words(table: dict[str, str], part: str) -> str:
    return table.get(part, part)
