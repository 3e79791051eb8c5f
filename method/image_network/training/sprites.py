"""Clips of any length from still renderings: parts of some, cut out along random outlines, move before others.

A burst of `make-msdi-data` holds the light of 43 ticks. The windows of `adaptive`, and what a clip's mean shows, reach
over hundreds, and over all of them things go on moving. So what moves here is drawn in the plane: a sprite is another
image behind a soft outline, which moves evenly, accelerates and turns, or a shadow, which darkens what it passes. Its
light is exact, its motion of any speed, and its texture about as sharp as what it covers: a pixel of its image is a
fine one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from spike4dgs.benchmark.arrays import Float32, Mask

_SLOWEST, _FASTEST = 0.004, 0.2  # px a tick
_KEY_PX = 0.6  # motion between two images
_MOST_KEYS = 160
_FINE = 2  # times the image's resolution: sprites are drawn so, a source's pixel to a fine one, and averaged
_EDGE = 0.02  # share of a pixel from which it counts as covered
_NEAR_TICKS = 10  # what moves covers a pixel so many ticks before or after


@dataclass(frozen=True, eq=False)
class Clip:
    """Light of one view: piecewise linear between images `spacing` ticks apart, the first at the start of tick 0."""

    keys: Float32  # [k, H, W]
    covered: Mask  # [k, H, W] what moves is there
    spacing: int  # ticks

    def at(self, tick: int) -> tuple[Float32, Mask]:
        """Return the light at the start of a tick, and where something moves, or has or will soon."""
        first = min(tick // self.spacing, len(self.keys) - 2)
        share = np.float32(tick / self.spacing - first)
        light = self.keys[first] * (1 - share) + self.keys[first + 1] * share
        reach = -(-_NEAR_TICKS // self.spacing)
        return light, np.asarray(self.covered[max(0, first - reach) : first + 2 + reach].any(axis=0))


@dataclass(frozen=True)
class _Path:
    """Where a sprite's middle is, in px, and how it is turned, of time in ticks."""

    start: complex
    velocity: complex
    acceleration: complex
    angle: float
    turn: float  # a tick

    def matrix(self, t: float, middle: complex) -> Float32:
        """Return the affine map [2, 3] from the sprite's image to the view, both in fine pixels."""
        turned = np.exp(1j * (self.angle + self.turn * t))
        at = _FINE * (self.start + self.velocity * t + self.acceleration * t * t / 2) - turned * middle
        return np.array([[turned.real, -turned.imag, at.real], [turned.imag, turned.real, at.imag]], np.float32)


def still(image: Float32, ticks: int) -> Clip:
    """Return a clip in which nothing moves."""
    keys = np.repeat(image[None], 2, axis=0)
    return Clip(keys, np.zeros(keys.shape, bool), ticks)


def with_sprites(image: Float32, others: Sequence[Float32], ticks: int, rng: np.random.Generator) -> Clip:
    """Return a clip of so many ticks of `image` [H, W] before which parts of the others [h, w] move."""
    sides = np.array(image.shape)
    speed = float(np.exp(rng.uniform(np.log(_SLOWEST), np.log(_FASTEST))))
    paths = [_path(sides, speed, ticks, rng) for _ in others]
    fastest = max(abs(p.velocity) + abs(p.acceleration) * ticks + abs(p.turn) * float(sides.min()) / 3 for p in paths)
    spacing = max(1, int(_KEY_PX / fastest), -(-ticks // (_MOST_KEYS - 1)))
    spacing = min(spacing, ticks)
    times = np.arange(-(-ticks // spacing) + 1) * spacing
    keys, covered = np.empty((len(times), *sides), np.float32), np.zeros((len(times), *sides), bool)
    size = (_FINE * image.shape[1], _FINE * image.shape[0])
    fine = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST), np.float32)  # averages are the image
    sprites = [(*_sprite(other, sides, rng), path) for other, path in zip(others, paths, strict=True)]
    for key, seen, t in zip(keys, covered, times.tolist(), strict=True):
        drawn, mask = fine.copy(), np.zeros_like(fine)
        for light, outline, shadow, path in sprites:
            middle = complex(outline.shape[1], outline.shape[0]) / 2
            placed = _warped(outline, path.matrix(t, middle), fine.shape)
            drawn *= 1 - placed * (1 - shadow)
            if shadow == 0:
                drawn += _warped(light, path.matrix(t, middle), fine.shape)
            mask = np.maximum(mask, placed)
        key[:] = _coarse(drawn)
        seen[:] = _coarse(mask) > _EDGE
    return Clip(keys, covered, spacing)


def _path(sides: np.ndarray, speed: float, ticks: int, rng: np.random.Generator) -> _Path:
    """Return a path that is in the view at a random time."""
    height, width = sides.tolist()
    direction = np.exp(2j * np.pi * rng.random())
    velocity = speed * rng.uniform(0.5, 1) * direction
    acceleration = speed / ticks * rng.uniform(0, 1) * np.exp(2j * np.pi * rng.random())
    when = rng.uniform(0, ticks)
    there = complex(rng.uniform(0, width), rng.uniform(0, height))
    start = there - velocity * when - acceleration * when**2 / 2
    turn = rng.normal() * speed / float(sides.min()) if rng.random() < 0.5 else 0.0
    return _Path(start, velocity, acceleration, rng.uniform(-np.pi, np.pi), turn)


def _sprite(other: Float32, sides: np.ndarray, rng: np.random.Generator) -> tuple[Float32, Float32, float]:
    """Return light and outline, both of one size in fine pixels, and what passes through: 0, or a shadow's share.

    An image that is smaller is mirrored at its ends.
    """
    side = int(_FINE * sides.min() * rng.uniform(0.25, 0.9))
    rows, columns = (int(rng.integers(0, max(1, s - side + 1))) + np.arange(side) for s in other.shape)
    whole = np.pad(other, [(0, max(0, side - s)) for s in other.shape], mode="symmetric")
    texture = whole[np.ix_(rows, columns)] * np.float32(np.exp(rng.normal() * 0.3))
    shadow = float(rng.uniform(0.2, 0.8)) if rng.random() < 0.2 else 0.0
    v, u = (np.mgrid[:side, :side] + 0.5) / side * 2 - 1
    angle, radius = np.arctan2(v, u), np.hypot(u, v)
    outline = 0.65 + sum(0.25 / k * rng.normal() * np.cos(k * angle + rng.uniform(0, 6.3)) for k in range(1, 7))
    soft = rng.uniform(4, 20) if shadow else 1.0  # fine pixels
    mask = np.clip((np.clip(outline, 0.15, 0.95) - radius) * side / 2 / soft + 0.5, 0, 1)
    return (texture * mask).astype(np.float32), mask.astype(np.float32), shadow


def _warped(image: Float32, matrix: Float32, shape: tuple[int, ...]) -> Float32:
    size = (shape[1], shape[0])
    return np.asarray(cv2.warpAffine(image, matrix, size, flags=cv2.INTER_LINEAR, borderValue=0), np.float32)


def _coarse(fine: Float32) -> Float32:
    size = (fine.shape[1] // _FINE, fine.shape[0] // _FINE)
    return np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), np.float32)
