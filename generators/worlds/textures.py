"""Procedural images [H, W, 3] float32, linear RGB reflectance, row 0 at the top."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

Colour = Sequence[float]

# ---------------------------------------------------------------- noise


def value_noise(shape: tuple[int, int], cell: float, rng: np.random.Generator) -> np.ndarray:
    """Return a smoothed random lattice in 0..1, [H, W] float32, `cell` pixels per lattice step; repeats seamlessly."""
    height, width = shape
    rows, columns = max(round(height / cell), 1), max(round(width / cell), 1)
    lattice = rng.random((rows, columns), dtype=np.float32)

    def taps(n: int, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        at = np.arange(n, dtype=np.float32) / n * k
        first = at.astype(np.int64) % k
        f = at - np.floor(at)
        return first, (first + 1) % k, f * f * (3 - 2 * f)

    x0, x1, fx = taps(width, columns)
    y0, y1, fy = taps(height, rows)
    wide = lattice[:, x0] * (1 - fx) + lattice[:, x1] * fx
    return wide[y0] * (1 - fy)[:, None] + wide[y1] * fy[:, None]


def fractal(
    shape: tuple[int, int], rng: np.random.Generator, coarse: float = 128, fine: float = 2, gain: float = 0.65
) -> np.ndarray:
    """Return the sum of value noises from `coarse` to `fine` pixels, each octave weaker by `gain`; spans 0..1."""
    total, weight, cell = np.zeros(shape, np.float32), 1.0, float(coarse)
    while cell >= fine:
        total += np.float32(weight) * value_noise(shape, cell, rng)
        weight, cell = weight * gain, cell / 2
    total -= total.min()
    return total / total.max()


def mix(amount: np.ndarray, low: Colour, high: Colour) -> np.ndarray:
    """Return the colours [H, W, 3] between `low` (0) and `high` (1)."""
    a, b = np.asarray(low, np.float32), np.asarray(high, np.float32)
    return a + (b - a) * amount[..., None]


# ---------------------------------------------------------------- plain materials


def asphalt(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Return a road surface: worn patches, grain and single light and dark stones."""
    image = mix(fractal(shape, rng, 160, 4), (0.085, 0.085, 0.09), (0.19, 0.185, 0.18))
    grain = rng.random(shape, dtype=np.float32)
    image *= (0.75 + 0.5 * grain)[..., None]
    stones = rng.random(shape, dtype=np.float32)
    image[stones > 0.975] = (0.36, 0.35, 0.33)
    image[stones < 0.02] *= 0.4
    return image


def paving(
    shape: tuple[int, int],
    rng: np.random.Generator,
    stone: tuple[int, int],
    low: Colour = (0.30, 0.28, 0.25),
    high: Colour = (0.52, 0.49, 0.44),
    joint: Colour = (0.14, 0.13, 0.12),
    spread: float = 0.28,
    gap: int = 1,
) -> np.ndarray:
    """Return pavers, bricks or tiles in running bond; `stone` = (height, width) in pixels."""
    height, width = shape
    y, x = np.mgrid[:height, :width]
    row = y // stone[0]
    x = x + (row % 2) * (stone[1] // 2)
    tone = rng.uniform(1 - spread, 1 + spread, (height // stone[0] + 1, width // stone[1] + 2)).astype(np.float32)
    image = mix(fractal(shape, rng, 64, 2), low, high) * tone[row, x // stone[1]][..., None]
    image[(y % stone[0] < gap) | (x % stone[1] < gap)] = joint
    return image


def wood(shape: tuple[int, int], rng: np.random.Generator, planks: int = 6) -> np.ndarray:
    """Return planks along the image's rows with grain, knots and dark joints."""
    height, width = shape
    plank = np.arange(height) * planks // height
    stretch = fractal((height, max(width // 8, 2)), rng, height / 4, 2)
    grain = stretch[:, np.arange(width) // 8 % stretch.shape[1]]
    shift = rng.uniform(0, 10, planks)[plank][:, None]
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (grain * 7 + shift + np.arange(width) / width * 0.7))
    amount = 0.55 * rings.astype(np.float32) + 0.25 * grain + 0.2 * value_noise(shape, 2, rng)
    image = mix(amount, (0.23, 0.12, 0.055), (0.52, 0.33, 0.18))
    image *= rng.uniform(0.78, 1.2, planks).astype(np.float32)[plank][:, None, None]
    joint = np.flatnonzero(np.diff(plank))
    image[joint] *= 0.25
    image[joint + 1] *= 0.45
    return image


BEACH_BALL: tuple[Colour, ...] = ((0.75, 0.12, 0.08), (0.80, 0.78, 0.70), (0.10, 0.25, 0.60), (0.80, 0.62, 0.10))


def cloth(shape: tuple[int, int], rng: np.random.Generator, colours: Sequence[Colour], stripe: int) -> np.ndarray:
    """Return vertical stripes of `stripe` pixels with a woven grain."""
    index = np.arange(shape[1]) // stripe % len(colours)
    image = np.broadcast_to(np.asarray(colours, np.float32)[index], (*shape, 3))
    return image * (0.75 + 0.4 * fractal(shape, rng, 24, 2))[..., None]


# ---------------------------------------------------------------- drawing


@lru_cache(maxsize=64)
def _font(pixels: int) -> ImageFont.FreeTypeFont:
    """Return DejaVu Sans Bold as matplotlib ships it (found without the slow import of matplotlib)."""
    spec = importlib.util.find_spec("matplotlib")
    assert spec is not None and spec.submodule_search_locations, "matplotlib is a dependency of this package"
    folder = Path(next(iter(spec.submodule_search_locations))) / "mpl-data/fonts/ttf"
    return ImageFont.truetype(str(folder / "DejaVuSans-Bold.ttf"), pixels)


class Canvas:
    """Draws on an image in metres: x to the right, y down, the origin in the top left corner.

    Shapes are drawn four times finer and averaged, and blended in linear light.
    """

    FINE = 4

    def __init__(self, image: np.ndarray, texels_per_m: float) -> None:
        self.image = np.array(image, np.float32)  # [H, W, 3]
        self.scale = float(texels_per_m)

    def polygon(self, points: Sequence[Sequence[float]] | np.ndarray, colour: Colour, opacity: float = 1.0) -> None:
        """Fill a polygon given by points (x, y)."""
        p = np.asarray(points, np.float64) * self.scale
        lo, mask, draw = self._patch(p.min(0), p.max(0))
        draw.polygon([tuple(q) for q in (p - lo) * self.FINE], fill=255)
        self._blend(lo, mask, colour, opacity)

    def rectangle(self, x0: float, y0: float, x1: float, y1: float, colour: Colour, opacity: float = 1.0) -> None:
        """Fill an axis-parallel rectangle."""
        self.polygon([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], colour, opacity)

    def ellipse(self, x: float, y: float, rx: float, ry: float, colour: Colour, opacity: float = 1.0) -> None:
        """Fill an axis-parallel ellipse."""
        a = np.linspace(0, 2 * np.pi, 72, endpoint=False)
        self.polygon(np.stack([x + rx * np.cos(a), y + ry * np.sin(a)], 1), colour, opacity)

    def line(self, points: Sequence[Sequence[float]], width: float, colour: Colour, opacity: float = 1.0) -> None:
        """Stroke a polyline."""
        p = np.asarray(points, np.float64) * self.scale
        pad = width * self.scale
        lo, mask, draw = self._patch(p.min(0) - pad, p.max(0) + pad)
        pen = max(round(width * self.scale * self.FINE), 1)
        draw.line([tuple(q) for q in (p - lo) * self.FINE], fill=255, width=pen, joint="curve")
        self._blend(lo, mask, colour, opacity)

    def text(
        self,
        words: str,
        x: float,
        y: float,
        height: float,
        colour: Colour,
        turn_deg: float = 0.0,
        mirrored: bool = False,
        opacity: float = 1.0,
    ) -> None:
        """Write `words` centred on (x, y), capitals `height` metres tall, turned counter-clockwise."""
        font = _font(max(round(height / 0.73 * self.scale * self.FINE), 4))
        box = font.getbbox(words)
        stamp = Image.new("L", (int(box[2] - box[0]) + 4, int(box[3] - box[1]) + 4), 0)
        ImageDraw.Draw(stamp).text((2 - box[0], 2 - box[1]), words, fill=255, font=font)
        if mirrored:
            stamp = stamp.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
        stamp = stamp.rotate(turn_deg, resample=Image.Resampling.BICUBIC, expand=True)
        middle, half = np.array([x, y]) * self.scale, np.array(stamp.size) / (2 * self.FINE)
        lo, mask, _ = self._patch(middle - half, middle + half)
        mask.paste(stamp, tuple(int(v) for v in np.round((middle - half - lo) * self.FINE)))
        self._blend(lo, mask, colour, opacity)

    def _patch(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, Image.Image, ImageDraw.ImageDraw]:
        """Return a fine drawing area over whole texels from `low` to `high`: its corner in texels, the mask, a pen."""
        lo = np.floor(low).astype(int) - 1
        size = np.maximum(np.ceil(high).astype(int) + 2 - lo, 1)
        mask = Image.new("L", (int(size[0]) * self.FINE, int(size[1]) * self.FINE), 0)
        return lo, mask, ImageDraw.Draw(mask)

    def _blend(self, lo: np.ndarray, mask: Image.Image, colour: Colour, opacity: float) -> None:
        fine = np.asarray(mask, np.float32) / 255
        h, w = fine.shape[0] // self.FINE, fine.shape[1] // self.FINE
        cover = fine.reshape(h, self.FINE, w, self.FINE).mean((1, 3)) * np.float32(opacity)
        y0, x0 = max(lo[1], 0), max(lo[0], 0)
        y1, x1 = min(lo[1] + h, self.image.shape[0]), min(lo[0] + w, self.image.shape[1])
        if y1 <= y0 or x1 <= x0:
            return
        cover = cover[y0 - lo[1] : y1 - lo[1], x0 - lo[0] : x1 - lo[0], None]
        area = self.image[y0:y1, x0:x1]
        area += cover * (np.asarray(colour, np.float32) - area)


def plain(shape: tuple[int, int], colour: Colour) -> np.ndarray:
    """Return an image of one colour."""
    return np.broadcast_to(np.asarray(colour, np.float32), (*shape, 3)).copy()
