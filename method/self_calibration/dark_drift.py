"""Dark rates that have changed since the calibration: a sensor 8 K warmer has twice its dark rate.

A pixel of sensitivity g fires at L g + s d: d is its dark rate in the recordings, s what they have become since.
Dark rates differ from pixel to pixel, and light hardly does but at edges. So s is the slope of the high-pass filtered
rate / g over that of d / g, each pixel weighted by what its surroundings leave unexplained: textures say little.

A scale that its error does not tell from 1, or that changes rates by less than a calibration's own noise, is 1.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.ndimage import uniform_filter

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.scene.calibration import Calibration, rates
from spike4dgs.benchmark.scene.scene import TrainingScene

_ROUNDS = 4
_AROUND_PX = 5  # side of the square whose residuals weigh a pixel
_LEAST = 0.1  # change of a scale that is worth it: a twentieth of a percent of white, for usual sensors
_ERRORS = 5.0  # standard errors that tell a scale from 1
_SENSITIVE = 0.2  # of the mean: less sensitive pixels are left out
_HOT = 10.0  # times the median dark rate: such pixels change by a law of their own


def in_todays_dark(scene: TrainingScene) -> TrainingScene:
    """Return a scene whose cameras' states have the scales of their dark rates: `scene` itself where all are 1."""
    states, known = dict(scene.states), scene.calibrations or ()
    for camera, stream, calibration in zip(scene.cameras, scene.streams, known):  # noqa: B905 (none are known)
        scale, error = dark_scale(rates(stream), calibration)
        if abs(scale - 1) > max(_LEAST, _ERRORS * error):
            states[camera.id] = replace(scene.state(camera.id), dark=max(scale, 0.0))
    return replace(scene, states=states) if any(state.dark != 1 for state in states.values()) else scene


def dark_scale(rate: Float64, calibration: Calibration) -> tuple[float, float]:
    """Return s and its standard error, from a clip's rates [H, W] in spikes per tick. Infinite: no scale."""
    gain = calibration.gain.astype(np.float64)
    good = (gain > _SENSITIVE) & (calibration.dark <= _HOT * np.median(calibration.dark))
    safe = np.where(good, gain, 1.0)
    seen, dark = (_high_pass(np.where(good, image / safe, 0.0)) for image in (rate, calibration.dark))
    used = uniform_filter(good.astype(np.float64), 3) > 1 - 1e-6  # its neighbours too
    scale, error = 1.0, math.inf
    for _ in range(_ROUNDS):
        rest = np.where(used, seen - scale * dark, 0.0) ** 2
        share = uniform_filter(used.astype(np.float64), _AROUND_PX)
        variance = uniform_filter(rest, _AROUND_PX) / np.maximum(share, 1e-3)
        floor = 0.1 * float(np.median(variance[used])) if used.any() else 0.0
        weight = used / np.maximum(variance, max(floor, 1e-12))
        if not (power := float((weight * dark**2).sum())) > 0:
            return 1.0, math.inf
        scale, error = float((weight * dark * seen).sum()) / power, power**-0.5
    return scale, error


def _high_pass(image: Float64) -> Float64:
    """Return an image [H, W] less the mean of each pixel's four neighbours; those beyond the border repeat it."""
    padded = np.pad(image, 1, mode="edge")
    return np.asarray(image - (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]) / 4)
