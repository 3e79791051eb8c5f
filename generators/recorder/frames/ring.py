"""The memory for one camera's reads: allocated before the capture starts, and always available to the next read.

Reads take slots in turn. If the consumer has not released one in time, the read goes to a spare buffer whose bytes are
dropped: the USB side continues, and the loss is known to the byte.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from spike4dgs.benchmark.arrays import UInt8

_SPARE = -1


@dataclass(frozen=True, slots=True)
class Block:
    """The data of one read: bytes [position, position + bytes) of the camera's stream. `data` is None if dropped."""

    data: UInt8 | None  # [bytes], a view of the ring, or a copy of a short read
    position: int
    bytes: int
    arrival_ns: int


class Ring:
    """`slots` buffers of `slot_bytes`, filled by one thread and emptied by another, both in order.

    The filling thread calls `take` for each read it queues and `put` for each that ended; the emptying thread calls
    `pop`, and `release` when it no longer needs the blocks.

    With `compact` blocks are never popped. Where no slot is free, the block of a short read is copied, which frees the
    slot that it does not fill: however many reads are short, the ring holds as many bytes.
    """

    def __init__(self, slots: int, slot_bytes: int, compact: bool = False) -> None:
        self.slots, self.slot_bytes, self._compact = slots, slot_bytes, compact
        self.memory = np.empty((slots + 1, slot_bytes), np.uint8)  # the last row is the spare buffer
        self.memory.fill(0)  # makes the system map the pages now, not while the camera sends
        self._lock = threading.Lock()
        self.reset()

    def reset(self) -> None:
        """Reset to no read in flight and no waiting block."""
        self.position = 0  # bytes received so far
        self.dropped = 0  # of these, in the spare buffer
        self.waiting = 0  # slots with blocks that the consumer has not popped
        self.backlog = 0  # most that waited at once
        self._flying: deque[int] = deque()
        self._filled: deque[tuple[int, Block]] = deque()
        self._short: deque[int] = deque()  # of the filled ones, those that may be copied
        self._free = deque(range(self.slots))  # neither in flight nor waiting nor popped
        self._popped: list[int] = []  # slots of the blocks that were popped last

    def take(self) -> UInt8:
        """Return the buffer [slot_bytes] for the next read: a free slot, or the spare one."""
        with self._lock:
            if not self._free and self._short:
                self._copy(self._short.popleft())
            slot = self._free.popleft() if self._free else _SPARE
        self._flying.append(slot)
        return self.memory[slot]

    def put(self, n: int, arrival_ns: int, keep: bool = True) -> Block:
        """Record that the oldest read has delivered `n` bytes, and queue them for the consumer if `keep`."""
        slot = self._flying.popleft()
        data = None if slot == _SPARE else self.memory[slot, :n]
        block = Block(data, self.position, n, arrival_ns)
        self.position += n
        if keep:
            self.dropped += n if data is None else 0
            with self._lock:
                if self._compact and slot != _SPARE and n < self.slot_bytes:
                    self._short.append(len(self._filled))
                self._filled.append((slot, block))
                self.waiting += slot != _SPARE
                self.backlog = max(self.backlog, self.waiting)
        elif slot != _SPARE:
            self._release([slot])
        return block

    def pop(self, most: int) -> list[Block]:
        """Return the oldest waiting blocks, at most `most`. Those popped before them are released."""
        self.release()
        with self._lock:
            taken = [self._filled.popleft() for _ in range(min(most, len(self._filled)))]
            self._popped = [slot for slot, _ in taken if slot != _SPARE]
            self.waiting -= len(self._popped)
        return [block for _, block in taken]

    def release(self) -> None:
        """Release the popped blocks' slots for further reads."""
        self._release(self._popped)
        self._popped = []

    def blocks(self) -> list[Block]:
        """Return every waiting block, oldest first; they keep waiting."""
        with self._lock:
            return [block for _, block in self._filled]

    def _copy(self, k: int) -> None:
        """Replace filled block `k` by a copy, and free its slot."""
        slot, block = self._filled[k]
        self._filled[k] = _SPARE, replace(block, data=self.memory[slot, : block.bytes].copy())
        self._free.append(slot)
        self.waiting -= 1

    def _release(self, slots: list[int]) -> None:
        with self._lock:
            self._free.extend(slots)
