"""The memory for reads, and the delivery of frames."""

from __future__ import annotations

import itertools
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.generators.recorder.frames.cutting import Cutter, joined
from spike4dgs.generators.recorder.frames.delivery import Delivery
from spike4dgs.generators.recorder.frames.layouts import make_layout
from spike4dgs.generators.recorder.frames.ring import Ring


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 6), st.integers(1, 3), st.lists(st.sampled_from(["take", "put", "pop", "discard"]), max_size=60))
def test_a_ring_never_overwrites_waiting_blocks(slots: int, most: int, steps: list[str]) -> None:
    ring, flying, waiting, number, position, popped = Ring(slots, 8), [], [], itertools.count(1), 0, []
    kept = False
    for step in steps:
        if step == "take":
            flying.append(ring.take())
        elif step in ("put", "discard") and flying:
            keep = kept = kept or step == "put"
            n = next(number)
            flying.pop(0)[:] = n % 256
            block = ring.put(n % 9, n, keep)
            assert (block.position, block.bytes) == (position, n % 9)
            position += n % 9
            if keep:
                waiting.append((block, n))
        elif step == "pop":
            popped, waiting = waiting[:most], waiting[most:]
            blocks = ring.pop(most)
            assert all(block is expected for block, (expected, _) in zip(blocks, popped, strict=True))
        for block, n in [*popped, *waiting]:
            assert block.data is None or (block.data == n % 256).all()
        held = sum(b.data is not None for b, _ in waiting)
        assert ring.waiting == held and held + sum(b.data is not None for b, _ in popped) <= slots
    assert ring.position == position


LAYOUT = make_layout("plain", 16, 8)  # 16 bytes a frame


def filled(blocks: int) -> dict[str, Ring]:
    """Return a ring in which this many blocks of three frames wait."""
    ring = Ring(blocks, 3 * LAYOUT.frame_bytes)
    for i in range(blocks):
        ring.take()[:] = i
        ring.put(ring.slot_bytes, i)
    return {"cam": ring}


def deliver(rings: dict[str, Ring], sink: object, n_ticks: int) -> Delivery:
    return Delivery(sink, rings, {"cam": Cutter("cam", LAYOUT, rings["cam"])}, n_ticks)  # type: ignore[arg-type]


def test_what_waits_is_delivered_up_to_the_end_of_the_clip() -> None:
    got: list[tuple[int, UInt8]] = []
    rings = filled(5)
    deliver(rings, lambda camera, first, frames: got.append((first, frames.copy())), 13).finish()
    assert [first for first, _ in got] == [0, 3, 6, 9, 12] and rings["cam"].waiting == 0
    frames = np.concatenate([f for _, f in got])
    np.testing.assert_array_equal(frames[:, 0], np.repeat(np.arange(5), 3)[:13])


@pytest.mark.parametrize(("n_ticks", "view"), [(15, True), (14, True), (16, False)])
def test_frames_beyond_the_clips_end_make_no_copy_of_it(n_ticks: int, view: bool) -> None:
    """A cancelled read brings some, in a block that is not full and so has no neighbour."""
    (ring,) = filled(6).values()
    blocks = ring.blocks()
    last = replace(blocks[-1], data=blocks[-1].data[:20].copy(), bytes=20)
    runs = Cutter("cam", LAYOUT, ring).cut([*blocks[:-1], last])
    frames, ticks = joined(runs, n_ticks, LAYOUT.frame_bytes)
    assert ticks.tolist() == list(range(n_ticks)) and np.shares_memory(frames, ring.memory) is view
    np.testing.assert_array_equal(frames[:, 0], np.repeat(np.arange(6), 3)[:n_ticks])


def test_an_error_of_the_sink_is_raised_at_the_end() -> None:
    def refuse(camera: str, first: int, frames: UInt8) -> None:
        raise OSError("disk full")

    delivery = deliver(filled(5), refuse, 15)
    with pytest.raises(OSError, match="disk full"):
        delivery.finish()
    delivery.abandon()


def test_an_abandoned_delivery_ends_after_the_block_that_the_sink_has() -> None:
    begun, go_on, rings = threading.Event(), threading.Event(), filled(5)

    def stall(camera: str, first: int, frames: UInt8) -> None:
        begun.set()
        assert go_on.wait(60)

    delivery = deliver(rings, stall, 15)
    assert begun.wait(60)
    end = threading.Thread(target=delivery.abandon)
    end.start()
    while not delivery._abandoned.is_set():
        time.sleep(1e-3)
    assert end.is_alive() and rings["cam"].waiting == 4, "it waits for the sink"
    go_on.set()
    end.join(60)
    assert not end.is_alive() and rings["cam"].waiting == 4
