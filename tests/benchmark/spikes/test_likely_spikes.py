"""Likely spikes: against a normal model of whole trains, and where a person would be certain."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from slow_likely import slow_likely

from spike4dgs.benchmark.spikes.likely_spikes import MOST, likely_spikes

TICKS = 160


def decided(spikes, lost):
    """Return which of `lost` are likely to hold a spike of a train, and where that is certain; None: nothing tells."""
    packed = np.zeros((TICKS, 1), np.uint8)
    packed[spikes] = 1
    before, after = (t for t in (max(s for s in spikes if s < lost[0]), min(s for s in spikes if s > lost[-1])))
    likely, sure = likely_spikes(packed, 0, before, after, np.array(lost))
    bits = ([t for d, t in enumerate(lost) if found >> d & 1] for found in (likely, sure))
    return None if likely < 0 else tuple(bits)


@settings(max_examples=200, deadline=None)
@example([2] * 60, 30, [0, 1, 2, 3, 4], 0)
@example([1] * 159, 80, [0, 1, 2, 3], 1)
@example([40, 40, 40], 1, [0, 1, 2, 3, 4], 2)
@example([50, 50], 0, [3], 3)
@given(
    st.lists(st.integers(1, 40), min_size=2, max_size=80),
    st.integers(0, 79),
    st.sets(st.integers(0, 60), min_size=1, max_size=MOST),
    st.integers(0, 2**31),
)
def test_the_likeliest_train_is_that_of_a_normal_model_of_all_its_ticks(intervals, gap, places, seed):
    times = np.cumsum([0, *intervals])
    times = times[times < TICKS].tolist()
    if len(times) < 2:
        return
    gap = min(gap, len(times) - 2)
    width = int(np.random.default_rng(seed).integers(1, 3))  # spikes that are lost in between
    p, q = times[gap], times[min(gap + width, len(times) - 1)]
    lost = sorted({p + 1 + place for place in places if p + 1 + place < q})
    if not lost:
        return
    before, after = [t for t in times if t <= p][::-1], [t for t in times if t >= q]
    expected, found = slow_likely(before, after, lost), decided(before + after, lost)
    if expected is None or found is None:
        assert expected is found is None
        return
    if expected[2] > 1e-6:
        assert found == expected[:2]


@pytest.mark.parametrize(
    ("spikes", "lost", "likely", "certain"),
    [
        (list(range(5, 160, 10)), [85], [85], [85]),
        (list(range(5, 160, 10)), [82], [], [82]),
        (list(range(TICKS)), [80], [80], [80]),
        (list(range(TICKS)), [78, 79, 80, 81], [78, 79, 80, 81], [78, 79, 80, 81]),
        (list(range(5, 160, 10)), [82, 85, 88], [85], [82, 85, 88]),
    ],
)
def test_what_is_plain_is_certain(spikes, lost, likely, certain):
    assert decided([t for t in spikes if t not in lost], lost) == (likely, certain)


def test_what_could_be_either_is_in_doubt():
    halves = [*range(5, 80, 5), 85, *range(95, 160, 10)]
    assert decided(halves, [80])[1] == [], "light halves at tick 75 or at 80"
    assert decided([10, 20, 30, 45, 55, 65], [38])[1] == [], "an interval of 15 ticks, or of 8 and 7"
    assert decided([40, 60], [50]) is None, "no interval tells"
