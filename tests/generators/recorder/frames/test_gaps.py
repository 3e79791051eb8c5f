"""Lists of gaps: which are read, and how they are merged."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.spikes.gaps import read_gaps
from spike4dgs.generators.recorder.frames.gaps import Gap, merged


@pytest.mark.parametrize(
    ("records", "message"),
    [
        ([{"camera": "a", "first_tick": 0, "ticks": 1}], "expected gaps {camera, first_tick, ticks, reason}"),
        ([{"camera": "b", "first_tick": 0, "ticks": 1, "reason": "x"}], "lie within the clip"),
        ([{"camera": "a", "first_tick": 9, "ticks": 2, "reason": "x"}], "lie within the clip"),
        ([{"camera": "a", "first_tick": 1, "ticks": 0, "reason": "x"}], "lie within the clip"),
        ([{"camera": "a", "first_tick": t, "ticks": 2, "reason": "x"} for t in (3, 2)], "do not overlap"),
        (3, "gaps {camera"),
    ],
)
def test_damaged_lists_of_gaps(records: list[dict[str, object]], message: str) -> None:
    with pytest.raises(UserError) as error:
        read_gaps(records, {"a": 10}, Path("scene.json"))
    assert message in str(error.value)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.builds(
            Gap, st.sampled_from("ab"), st.integers(-5, 25), st.integers(0, 9), st.sampled_from(("stall", "overflow"))
        ),
        max_size=8,
    )
)
def test_merged_gaps_cover_the_same_ticks_once(gaps: list[Gap]) -> None:
    found = merged(gaps, 20)
    for camera in "ab":
        covered = sorted(t for g in found if g.camera == camera for t in range(g.first_tick, g.stop_tick))
        expected = {t for g in gaps if g.camera == camera for t in range(g.first_tick, g.stop_tick) if 0 <= t < 20}
        assert covered == sorted(expected)
    for a, b in zip(found[:-1], found[1:], strict=True):
        assert a.camera != b.camera or a.stop_tick < b.first_tick or a.reason != b.reason
