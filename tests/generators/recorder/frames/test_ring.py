"""The ring of one camera's reads, in any order of its operations."""

from __future__ import annotations

import itertools

from hypothesis import given, settings
from hypothesis import strategies as st

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
