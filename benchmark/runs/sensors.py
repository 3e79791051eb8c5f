"""The sensor of a scene in one word, so that results on clean and on noisy spikes are not mixed up."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

IDEAL, PARTLY, NOISY, RECORDED = "ideal", "partly noisy", "noisy", "recorded"
SENSORS = (IDEAL, PARTLY, NOISY, RECORDED)  # as in result.schema.json
TERMS = ("gain_map", "dark_map", "photons_per_spike")  # of the simulated noise; false or null where it is off


def sensor_of(meta: Mapping[str, Any]) -> str | None:
    """Return the sensor that scene.json states: one of `SENSORS`, or None where it does not say.

    A simulated one is noisy with all `TERMS`, ideal without any, and partly noisy between.

    >>> sensor_of({"sensor": {"gain_map": True, "dark_map": True, "photons_per_spike": None}, "source": {"kind": "x"}})
    'partly noisy'
    """
    if meta["source"]["kind"] == "recorder":
        return RECORDED
    if not all(term in meta["sensor"] for term in TERMS):
        return None
    on = sum(bool(meta["sensor"][term]) for term in TERMS)
    return IDEAL if not on else NOISY if on == len(TERMS) else PARTLY
