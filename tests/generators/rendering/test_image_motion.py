"""How fast images move, and how dense key frames have to be."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from built_worlds import built
from hypothesis import given, settings
from hypothesis import strategies as st

from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.rendering.image_motion import KeyPlan, max_image_speed, spacings
from spike4dgs.generators.rig import cameras


def test_twice_the_pixels_are_twice_the_speed_in_the_image():
    world = built("blank")
    one, two = (max_image_speed(world, cameras(world, 64 * k, 40 * k, (0, 4)), 0.02) for k in (1, 2))
    assert two == pytest.approx(2 * one, rel=1e-3)


@settings(max_examples=200, deadline=None)
@given(
    speed=st.floats(0, 1e6),
    n_ticks=st.integers(1, 20_000),
    per_ms=st.sampled_from([1, 7, 10, 20, 40]),
    max_px=st.floats(0.05, 4),
)
def test_spacings_and_the_ticks_they_give(speed, n_ticks, per_ms, max_px):
    rate_hz = 1000 * per_ms
    chain = spacings(speed, n_ticks, rate_hz, max_px)
    plan = KeyPlan(n_ticks, rate_hz, max_px, chain)
    assert per_ms % chain[0] == 0  # so every whole millisecond is a whole key
    assert all(a > b and a % b == 0 for a, b in itertools.pairwise(chain))
    finest = chain[-1]
    assert finest == 1 or speed * finest / rate_hz <= max_px
    wider = [d for d in range(finest + 1, per_ms + 1) if per_ms % d == 0]
    assert not wider or speed * wider[0] / rate_hz > max_px  # and it is the widest
    assert len(chain) == 1 or speed * chain[0] / rate_hz <= 2.5
    ticks = plan.ticks
    assert ticks[0] == 0 and set(np.diff(ticks)) == {finest}
    assert ticks[-1] - chain[0] < n_ticks <= ticks[-1] and ticks[-1] % chain[0] == 0
    for tick in ticks[:50]:
        level = plan.level(tick)
        assert tick % chain[level] == 0 and all(tick % coarser for coarser in chain[:level])


@pytest.mark.parametrize(
    "arguments", [(1.0, 10, 20_500, 0.5), (1.0, 0, 20_000, 0.5), (1.0, 10, 500, 0.5), (1.0, 10, 20_000, 0.0)]
)
def test_spacings_refuse_what_they_cannot_divide(arguments):
    with pytest.raises(UserError, match="key frames"):
        spacings(*arguments)
