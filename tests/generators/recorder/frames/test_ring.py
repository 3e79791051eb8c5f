"""The ring of one camera's reads, in any order of its operations."""

from __future__ import annotations

import itertools

from hypothesis import given, settings
from hypothesis import strategies as st

from spike4dgs.generators.recorder.frames.ring import Ring


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 6), st.lists(st.sampled_from(["take", "put", "pop", "discard"]), max_size=60))
def test_a_ring_never_overwrites_waiting_blocks(slots: int, steps: list[str]) -> None:
    ring, flying, waiting, number, position, popped = Ring(slots, 8), [], [], itertools.count(1), 0, False
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
            block = ring.pop()
            popped = False
            if waiting:
                expected, n = waiting.pop(0)
                popped = expected.data is not None
                assert block is expected
                assert block.data is None or (block.data == n % 256).all()
            else:
                assert block is None
        for block, n in waiting:
            assert block.data is None or (block.data == n % 256).all()
        held = sum(b.data is not None for b, _ in waiting)
        assert ring.waiting == held and held + popped <= slots
    assert ring.position == position
