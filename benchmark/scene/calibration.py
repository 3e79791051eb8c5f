"""A camera's response to light, estimated from recordings that any owner can make: under uniform light, in the dark.

A pixel's rate is (spikes - 1) / (ticks between the first and the last), which does not depend on the charge before the
first spike and after the last: over T ticks it is wrong by about 1 / T, where a count is by 1 / (rate T). Then

    gain = (rate under uniform light - dark rate) / its mean,      dark = rate in the dark

The gain map is the n(x, y) of Spike4DGS (eq. 15): a method that wants it takes the estimate, never a simulator's truth.
A recording is raw (calibration/flat/CAMERA.dat) or counted (.npz), with the same estimates to the last bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.manifest import Manifest
from spike4dgs.benchmark.screen.shown import Shown
from spike4dgs.benchmark.spikes.counted_recording import Recording, first_last_total, open_counted, total_counts
from spike4dgs.benchmark.spikes.sensor_model import gathered
from spike4dgs.benchmark.spikes.stream import open_stream

_MOST_SATURATED = 0.05  # share of the pixels; twice the usual light saturates up to 0.008 of them, 2.2 times 0.1


@dataclass(frozen=True, eq=False, repr=False)
class Recordings(Shown):
    """Two recordings of one camera: under uniform light of a known radiance, and in the dark."""

    flat: Recording
    dark: Recording
    flat_radiance: float

    def _about(self) -> str:
        size = f"{self.flat.width}x{self.flat.height} pixels"
        ticks = f"{self.flat.n_ticks} ticks under light of {self.flat_radiance:g}, {self.dark.n_ticks} in the dark"
        return f"of a camera: {size}, {ticks}"


def find_recordings(meta: Mapping[str, Any], files: Manifest, camera: str, size: tuple[int, int]) -> Recordings | None:
    """Return a camera's recordings, raw or counted; None where the scene has none. `meta`: scene.json.

    `size` is (width, height). Raises UserError where a file is missing, damaged or not of this camera.
    """
    facts: Mapping[str, Any] = meta.get("calibration", {})
    if not {"flat_radiance", "flat_ticks", "dark_ticks"} <= set(facts):
        return None
    order, found = bool(meta["sensor"]["rows_bottom_up"]), list[Recording]()
    dead = float(meta["sensor"].get("dead_ticks", 0))
    for name in ("flat", "dark"):
        path, ticks = f"calibration/{name}/{camera}", int(facts[f"{name}_ticks"])
        if f"{path}.npz" in files.files and f"{path}.dat" not in files.files:
            found.append(replace(open_counted(files.path(f"{path}.npz"), *size, ticks), dead_ticks=dead))
            continue
        raw = files.path(f"{path}.dat")
        rate_hz = float(meta["rate_hz"])
        found.append(open_stream(raw, *size, rate_hz, rows_bottom_up=order, n_ticks=ticks, dead_ticks=dead))
    return Recordings(found[0], found[1], float(facts["flat_radiance"]))


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Shown):
    """A camera's response to light, as estimated from its recordings, or what a clip tells of it."""

    gain: Float32  # [H, W] relative sensitivity, mean 1
    dark: Float32  # [H, W] spikes per tick in the dark
    radiance_gain: float  # spikes per tick of a pixel of gain 1 at radiance 1, without the dark rate
    of_pixels: bool = True  # False: a smooth shading alone, as a clip tells it

    def _about(self) -> str:
        height, width = self.gain.shape
        dead = int((self.gain <= 0).sum())
        return f"of a camera: {width}x{height} pixels, {dead} dead, {self.radiance_gain:.4g} spikes per tick of white"

    @staticmethod
    def of_shading(shading: Float32, radiance_gain: float) -> Calibration:
        """Return what is known of a camera's response where only its smooth shading [H, W] is."""
        return Calibration(shading, np.zeros_like(shading), radiance_gain, of_pixels=False)

    def in_dark_of(self, scale: float) -> Calibration:
        """Return the response with dark rates `scale` times as high: itself for 1."""
        return self if scale == 1 else replace(self, dark=self.dark * np.float32(scale))

    @property
    def mean_dark(self) -> np.float32:
        """The mean dark rate of the pixels that respond to light, in spikes per tick."""
        return np.float32(self.dark[self.gain > 0].mean())

    def radiance(self, rate: Float32) -> Float32:
        """Return the linear radiance of rates [..., H, W] in spikes per tick; pixels without sensitivity give 0."""
        light = np.maximum(rate - self.dark, 0)
        return np.asarray(light / np.where(self.gain > 0, self.gain, np.inf) / self.radiance_gain, np.float32)


def estimate(recordings: Recordings) -> Calibration:
    """Return the gain and dark maps of a camera. A pixel that never fires under uniform light is dead: its gain is 0.

    Raises UserError where the recordings do not fit together, where no pixel responds to the light, or where many are
    saturated: a pixel that fires in every tick tells nothing of its sensitivity.
    """
    flat, dark = recordings.flat, recordings.dark
    if (flat.width, flat.height) != (dark.width, dark.height) or recordings.flat_radiance <= 0:
        found = f"{flat.width}x{flat.height}, {dark.width}x{dark.height} and radiance {recordings.flat_radiance:g}"
        raise problem("calibration", "two recordings of one size and a positive radiance", found, "correct them")
    spikes = total_counts(flat)
    if (saturated := float((spikes == flat.n_ticks).mean())) > _MOST_SATURATED:
        found, again = f"{saturated:.0%} of the pixels fire in every tick", "record it again in dimmer light"
        raise problem("flat-field recording", f"at most {_MOST_SATURATED:.0%} saturated pixels", found, again)
    dark_rate = rates(dark)
    light = np.where(spikes > 0, np.maximum(rates(flat) - dark_rate, 0), 0)
    if not (mean := float(light.mean())) > 0:
        raise problem("flat-field recording", "light", "no more spikes than in the dark", "record it again")
    return Calibration((light / mean).astype(np.float32), dark_rate.astype(np.float32), mean / recordings.flat_radiance)


def rates(recording: Recording) -> Float64:
    """Return the charge per tick [H, W] under steady light: spikes per tick, while pixels collect light.

    A pixel without spikes counts as having half of one.
    """
    first, last, total = first_last_total(recording)
    span = np.maximum(last - first, 1)
    fired = np.where(total > 1, (total - 1) / span, np.maximum(total, 0.5) / recording.n_ticks)
    return np.asarray(gathered(fired, recording.dead_ticks))
