"""Gaps of a recording: ticks that a camera has no data of. Its stream holds zeros there, which are no measurement.

scene.json (and stream.json of a recording without poses) lists every gap, so that a reader can refuse the recording,
leave the ticks out of a rate, or show them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Mask
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.untrusted import MAX_TICKS, whole


@dataclass(frozen=True, order=True)
class Gap:
    """Ticks [first_tick, first_tick + ticks) of a camera, counted from the first one of the clip, and why they lack."""

    camera: str
    first_tick: int
    ticks: int
    reason: str

    @property
    def stop_tick(self) -> int:
        """The first tick after the gap."""
        return self.first_tick + self.ticks

    @property
    def record(self) -> dict[str, Any]:
        """The gap as scene.json lists it."""
        return asdict(self)


def read_gaps(records: Sequence[Mapping[str, Any]], n_ticks: Mapping[str, int], path: Path) -> tuple[Gap, ...]:
    """Return the gaps that a description lists, in order of camera and tick. `n_ticks`: of each camera's stream.

    Raises UserError where a record is none, names no camera of the recording, leaves its clip or overlaps another.
    """

    def parse(record: Mapping[str, Any]) -> Gap:
        first, ticks = (whole(record[key], 0, MAX_TICKS) for key in ("first_tick", "ticks"))
        return Gap(str(record["camera"]), first, ticks, str(record["reason"]))

    try:
        gaps = sorted(map(parse, records))
    except (KeyError, TypeError, ValueError) as e:
        raise problem(path, "gaps {camera, first_tick, ticks, reason}", repr(e), "restore the file") from None
    for i, gap in enumerate(gaps):
        inside = gap.ticks > 0 and gap.first_tick >= 0 and gap.stop_tick <= n_ticks.get(gap.camera, 0)
        after = i == 0 or gaps[i - 1].camera != gap.camera or gaps[i - 1].stop_tick <= gap.first_tick
        if not (inside and after):
            expected = f"gaps of its cameras that {'do not overlap' if inside else 'lie within the clip'}"
            raise problem(path, expected, str(gap.record), "restore the file")
    return tuple(gaps)


def refuse_gaps(gaps: Sequence[Gap], path: Path, allow_gaps: bool) -> None:
    """Raise UserError where there are gaps, unless they are allowed. Recordings are refused here and nowhere else."""
    if gaps and not allow_gaps:
        g = gaps[0]
        found = f"{len(gaps)} gap(s), the first: {g.camera} from tick {g.first_tick}, {g.ticks} ticks ({g.reason})"
        fix = "pass --allow-gaps, where the command takes it, to read it all the same"
        raise problem(path, "a recording without gaps", found, fix)


def present(gaps: Iterable[Gap], n_ticks: int) -> Mask:
    """Return which ticks of one camera's clip have data: [n_ticks] bool."""
    mask = np.ones(n_ticks, np.bool_)
    for gap in gaps:
        mask[gap.first_tick : gap.stop_tick] = False
    return mask
