"""Spike rates of a capture in progress."""

from __future__ import annotations

import math

import numpy as np
import pytest
from fake_camera import HEIGHT, WIDTH, layout_of, rig

from spike4dgs.generators.recorder.frames.ring import Block
from spike4dgs.generators.recorder.sync import spikes_per_tick


@pytest.mark.parametrize("layout", ["plain", "tagged-rows"])
def test_spike_rates_are_counted_in_whole_frames(layout: str) -> None:
    shape = layout_of(rig(1, layout))
    pixels = np.zeros((8, shape.payload_bytes), np.uint8)
    pixels[:, 0] = 0b1011
    stream = shape.pack(pixels).reshape(-1)
    block = Block(stream[11:], 11, len(stream) - 11, 0)
    assert spikes_per_tick(shape, block) == 3 / (WIDTH * HEIGHT)
    assert math.isnan(spikes_per_tick(shape, Block(stream[11:30], 11, 19, 0)))
    assert math.isnan(spikes_per_tick(shape, None))
