"""How two renderers' images differ: their noise is known from two renderings of each, and taken off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Float32, Mask
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import gray
from spike4dgs.generators.rendering.mitsuba_scene import mitsuba_scene
from spike4dgs.generators.rendering.mitsuba_variant import load_mitsuba
from spike4dgs.generators.rendering.scalar_tiles import load_sensor
from spike4dgs.generators.truth import errors
from spike4dgs.generators.worlds import WorldScene
from spike4dgs.generators.worlds.base import Part
from spike4dgs.generators.worlds.surfaces import Material
from spike4dgs.studies.second_renderer.checks import dressed

_SAMPLES = 16  # by which a pixel's materials are found
_PURE = 0.99  # of a pixel's samples
_SURE = 3  # standard errors
_LEAST = 20  # pixels of a material


@dataclass(frozen=True)
class Decibels:
    """A mean squared difference as PSNR; `at_least` where it is lost in the noise: then it is a bound."""

    value: float
    at_least: bool

    def __str__(self) -> str:
        return f"{'> ' if self.at_least else ''}{self.value:.1f}"


def decibels(squares: Float32) -> Decibels:
    """Return the mean of values [K], each an unbiased estimate of a squared difference."""
    mean = float(np.mean(squares, dtype=np.float64))
    error = _SURE * float(np.std(squares, dtype=np.float64)) / np.sqrt(squares.size)
    lost = mean <= error
    return Decibels(float(-10 * np.log10(max(mean, 0) + error if lost else mean)), bool(lost))


def compare(ours: Float32, second: Float32, moving: Mask) -> dict[str, Any]:
    """Return how two renderers differ in a view: images [2, H, W, 3] of each, and where objects move [H, W].

    Of gray radiance. Differences in dB are without noise; noise is that of one rendering; the mean relative error is of
    the means of both renderings, and has their noise. Ratios are of the second renderer to ours.
    """
    a, b = gray(ours), gray(second)
    off = (a[0] - b[0]) * (a[1] - b[1])
    found: dict[str, Any] = {}
    for name, where in (("whole", np.ones_like(moving)), ("moving", moving), ("static", ~moving)):
        means = a.mean(0), b.mean(0)
        found[name] = {
            "difference": decibels(off[where]),
            "noise_db": [float(-10 * np.log10(np.mean((x[0] - x[1])[where] ** 2) / 2)) for x in (a, b)],
            "mean_percent": errors(means[1], means[0], where)["mean_percent_moving"],
            "mean_ratio": float(means[1][where].mean() / means[0][where].mean()),
        }
    return found


def kind_of(material: Material) -> str:
    """Return the kind of a material: "matte", or a coat or metal and its roughness."""
    if material.gloss is None:
        return "matte"
    return f"{'metal' if material.metal else 'coat'}, roughness {material.gloss:g}"


def ratios(ours: Float32, second: Float32, pixels: dict[str, Mask]) -> dict[str, dict[str, float]]:
    """Return the median ratio of gray radiance, the second renderer's to ours, by kind of material."""
    ratio = gray(second).mean(0) / np.maximum(gray(ours).mean(0), 1e-6)
    return {
        kind: {"pixels": int(where.sum()), "median_ratio": float(np.median(ratio[where]))}
        for kind, where in pixels.items()
        if where.sum() >= _LEAST
    }


def kinds(world: WorldScene, camera: Camera, t_s: float) -> dict[str, Mask]:
    """Return where [H, W] a camera sees each kind of material alone, in all of the pixel."""
    parts = [*world.static.values(), *(p for group in world.groups.values() for p in group)]
    parts += [surface.part for surface in world.deforming.values()]
    names = sorted({kind_of(part.material) for part in parts})
    found = {}
    for first in range(0, len(names), 3):
        some = names[first : first + 3]
        for name, share in zip(some, _shares(world, camera, t_s, some), strict=False):
            found[name] = share >= _PURE
    return found


def _shares(world: WorldScene, camera: Camera, t_s: float, some: Sequence[str]) -> list[Float32]:
    """Return the share [H, W] of each pixel that up to three kinds of material have: colours of a painted world."""
    mi = load_mitsuba()

    def paint(part: Part) -> Part:
        red, green, blue = (float(kind_of(part.material) == (*some, "", "")[k]) for k in range(3))
        return Part(part.mesh, Material((red, green, blue)))

    scene = mitsuba_scene(dressed(world, paint))
    scene.set_time(t_s)
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height}
    integrator = mi.load_dict({"type": "aov", "aovs": "albedo:albedo"})
    image = np.array(mi.render(scene.full, sensor=load_sensor(camera, film, _SAMPLES), integrator=integrator))
    low, high = 0.01, 0.95  # what `reflectance` makes of 0 and 1
    return list(np.moveaxis((image[..., -3:] - low) / (high - low), -1, 0))
