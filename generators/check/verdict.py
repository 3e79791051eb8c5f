"""The verdict on a scene and its reference: equal, rendering noise, or a change of the world.

A second rendering of the made scene, with other noise and nothing else changed, gives the floor. What differs from the
reference as much as from that rendering differs by noise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from spike4dgs.generators.check.differences import Difference

EQUAL, NOISE, CHANGE = "equal", "rendering noise", "change of the world"
# The most that a difference may be of that between two noises. Between Mitsuba's variants the measures of a camera were
# 0.90 to 1.06 times that (car-0-tiny), those of blocks over all cameras 0.80 to 1.59: few blocks are noisy.
MOST_OF_CAMERA = {"bits": 1.25, "truth_rms": 1.5}
MOST_OF_BLOCKS = {
    "spikes_block_rms": 1.75,
    "truth_block_rms": 1.75,
    "spikes_block_max": 2.5,
    "truth_block_max": 2.5,
}
MEANING = {
    "bits": "spike bits",
    "truth_rms": "truths",
    "spikes_block_rms": "spikes per tick in blocks",
    "truth_block_rms": "truths in blocks",
    "spikes_block_max": "spikes per tick in the worst block",
    "truth_block_max": "truths in the worst block",
}
_NEGLIGIBLE = 1e-6  # of white, or of the bits: rounding alone


@dataclass(frozen=True)
class Comparison:
    """A made scene, its reference, and what differs; `noise` is the floor of `found`, by camera."""

    scene: str
    revision: str
    reference_revision: str
    facts: Sequence[str] = ()
    found: Mapping[str, Difference] = field(default_factory=dict)
    noise: Mapping[str, Difference] = field(default_factory=dict)

    @property
    def reasons(self) -> list[str]:
        """What noise does not explain."""
        return [*self.facts, *beyond_noise(self.found, self.noise)]

    @property
    def verdict(self) -> str:
        """EQUAL, NOISE or CHANGE."""
        if self.revision == self.reference_revision:
            return EQUAL
        return CHANGE if self.reasons else NOISE

    @property
    def record(self) -> dict[str, Any]:
        """The comparison as JSON."""
        cameras = {
            camera: {"found": d.record, "noise": self.noise[camera].record if camera in self.noise else None}
            for camera, d in self.found.items()
        }
        revisions = {"revision": self.revision, "reference_revision": self.reference_revision}
        return {"scene": self.scene, "verdict": self.verdict, **revisions, "reasons": self.reasons, "cameras": cameras}


def beyond_noise(found: Mapping[str, Difference], noise: Mapping[str, Difference]) -> list[str]:
    """Return one line for each measure by which the cameras of `noise` differ more than noise explains."""
    lines = []
    for camera in noise:
        lines += _beyond(camera, MOST_OF_CAMERA, _values([found[camera]]), _values([noise[camera]]))
    all_found, all_noise = _values([found[camera] for camera in noise]), _values(list(noise.values()))
    return lines + _beyond("all cameras", MOST_OF_BLOCKS, all_found, all_noise)


def _values(differences: Sequence[Difference]) -> dict[str, float]:
    """Return each measure over several cameras: the largest `_max`, of others the RMS."""
    values = {}
    for name in MEANING:
        if own := [value for d in differences if (value := getattr(d, name)) is not None]:
            values[name] = max(own) if name.endswith("_max") else math.sqrt(sum(v * v for v in own) / len(own))
    return values


def _beyond(where: str, most: Mapping[str, float], found: Mapping[str, float], noise: Mapping[str, float]) -> list[str]:
    lines = []
    for name in most.keys() & found.keys() & noise.keys():
        if found[name] > max(most[name] * noise[name], _NEGLIGIBLE):
            times = f"{found[name] / noise[name]:.3g} times as much as" if noise[name] else "and not"
            lines.append(f"{where}: {MEANING[name]} differ {times} by noise; up to {most[name]:g} times is noise")
    return sorted(lines)
