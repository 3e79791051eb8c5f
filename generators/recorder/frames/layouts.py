"""Frame layouts: the format of a camera's frames on the wire, and their conversion to packed ticks.

| name | frame | torn frames are detected by | frames are counted by |
|---|---|---|---|
| `plain` | the packed tick, ceil(W H / 8) bytes (400x250: 12,500) | nothing | nothing |
| `padded-rows` | rows of W pixels and 16 bits without a meaning (400x250: 13,000) | nothing | nothing |
| `tagged-rows` | rows of W pixels and 16 tag bits (400x250: 250 rows of 52 bytes, 13,000) | tags | tags, modulo 2^32 |
| `line-tagged` | blocks of W / 2 pixels and 12 tag bits (1000x1000: 2000 of 64 bytes, 128,000) | tags | nothing |

The tags of the cameras with rows of 416 columns have not been published. `tagged-rows` defines a rule of our own, which
the emulator follows: row r of frame n ends in the 16-bit little-endian word

    w(r) = a(r mod 2) + 257 r  (mod 2^16),    a(0) = n mod 2^16,    a(1) = (n div 2^16) + 40503 (n mod 2^16)

Every row thus states its number and, together with its neighbour, the frame's: both bytes of the word grow by one from
row to row, which no image does. Two rows give n modulo 2^32 (59 hours at 20 kHz), all others confirm it. As 40503 is
odd, rows of frames n and n + m disagree for every m that is not a multiple of 2^16. A frame that begins with one and
ends with the other is therefore detected, with two exceptions: if they meet within the first row, whose tag comes after
its pixels, or, in the dark and with a zero tag (n a multiple of 2^16), within the second row. The tick is correct even
then. A camera with other tags needs another class here, or is recorded as `padded-rows`.

`line-tagged` is the published format of the 1000x1000 camera: a block's last word holds 4 pixels (bits 0..3), the line
1..H/2 (bits 4..13) and the channel (14..15). Blocks come as (H/2, 0), (H/2, 1), (H/2 - 1, 0) ... (1, 1), then (1, 2),
(1, 3), (2, 2) ... (H/2, 3): two make a row. This camera's images are turned by 180 degrees against the scene.

Pixels are row-major and least significant bit first in every layout, as in `benchmark/spikes/stream.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import Int64, UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.spikes.bits import rows
from spike4dgs.benchmark.spikes.stream import bytes_per_tick
from spike4dgs.generators.recorder.frames.layout_kernels import (
    LINE_BITS,
    MIX,
    STEP,
    check_lines,
    count_tagged,
    find_lines,
    find_tagged,
    line_tags,
    unpack_lines,
)

PLAIN, PADDED_ROWS, TAGGED_ROWS, LINE_TAGGED = "plain", "padded-rows", "tagged-rows", "line-tagged"
COUNTER = 1 << 32  # frame counters count modulo this
_TAG_BYTES = 2


@dataclass(frozen=True)
class Layout:
    """Frames of `frame_bytes` on the wire, of which `payload_bytes` are the packed pixels in the order of the camera.

    This class is `plain`; the others override its methods.
    """

    name: str
    width: int
    height: int
    frame_bytes: int
    has_tags: bool = False  # they locate and check frames; without tags a stream's first byte begins a frame
    count_tags: bool = False  # every frame carries a counter

    @property
    def packed(self) -> bool:
        """True if a frame is its packed tick, and nothing else."""
        return self.frame_bytes == self.payload_bytes

    @property
    def payload_bytes(self) -> int:
        """Bytes of one packed tick."""
        return bytes_per_tick(self.width, self.height)

    def find(self, data: UInt8) -> int:
        """Return the offset of the first whole frame in a byte stream [n]; -1 if there is none. Only with tags."""
        raise ValueError(f"frames of layout {self.name} cannot be found")

    def counts(self, raw: UInt8) -> Int64:
        """Return the counters [n] of raw frames [n, frame_bytes]: 0 without counters, TORN where tags disagree."""
        return np.zeros(len(raw), np.int64)

    def unpack(self, raw: UInt8, out: UInt8) -> None:
        """Write the pixels of raw frames [n, frame_bytes] to out [n, payload_bytes], C-contiguous."""
        np.copyto(out, raw)

    def pack(self, payload: UInt8, first_count: int = 0) -> UInt8:
        """Return packed ticks [n, payload_bytes] as raw frames [n, frame_bytes], counted from `first_count`."""
        return payload.copy()


class _PaddedRows(Layout):
    @property
    def _row_bytes(self) -> int:
        return self.width // 8 + _TAG_BYTES

    def unpack(self, raw: UInt8, out: UInt8) -> None:
        n, pixels = len(raw), self._row_bytes - _TAG_BYTES
        target = out.view()
        target.shape = n, self.height, pixels  # never a copy
        np.copyto(target, raw.reshape(n, self.height, self._row_bytes)[:, :, :pixels])

    def pack(self, payload: UInt8, first_count: int = 0) -> UInt8:
        raw = np.zeros((len(payload), self.height, self._row_bytes), np.uint8)
        raw[:, :, :-_TAG_BYTES] = payload.reshape(len(payload), self.height, -1)
        return raw.reshape(len(payload), self.frame_bytes)


class _TaggedRows(_PaddedRows):
    def find(self, data: UInt8) -> int:
        return int(find_tagged(rows(data), self.height, self._row_bytes))

    def counts(self, raw: UInt8) -> Int64:
        out = np.empty(len(raw), np.int64)
        count_tagged(rows(raw), self.height, self._row_bytes, out)
        return out

    def pack(self, payload: UInt8, first_count: int = 0) -> UInt8:
        n = len(payload)
        raw = super().pack(payload).reshape(n, self.height, self._row_bytes)
        counts = (first_count + np.arange(n)) % COUNTER
        low, high = counts % 65536, counts // 65536
        words = np.stack([low, high + MIX * low], axis=1)[:, np.arange(self.height) % 2]  # [n, H]
        words = (words + STEP * np.arange(self.height)) % 65536
        raw[:, :, -2], raw[:, :, -1] = words % 256, words // 256
        return raw.reshape(n, self.frame_bytes)


class _LineTagged(Layout):
    def find(self, data: UInt8) -> int:
        return int(find_lines(rows(data), self.width, self.height))

    def counts(self, raw: UInt8) -> Int64:
        out = np.empty(len(raw), np.int64)
        check_lines(rows(raw), self.width, self.height, out)
        return out

    def unpack(self, raw: UInt8, out: UInt8) -> None:
        unpack_lines(rows(raw), self.width // 16, out.reshape(len(raw) * self.height, self.width // 8))

    def pack(self, payload: UInt8, first_count: int = 0) -> UInt8:
        n, half = len(payload), self.width // 2
        pixels = np.unpackbits(payload, axis=1, bitorder="little").reshape(n, 2 * self.height, half)
        tags = (line_tags(self.height)[:, None] >> np.arange(LINE_BITS + 2)) & 1  # [2 H, 12]
        bits = np.concatenate([pixels, np.broadcast_to(tags.astype(np.uint8), (n, *tags.shape))], axis=2)
        return np.packbits(bits.reshape(n, -1), axis=1, bitorder="little")


LAYOUTS = (PLAIN, PADDED_ROWS, TAGGED_ROWS, LINE_TAGGED)


def make_layout(name: str, width: int, height: int) -> Layout:
    """Return the layout of that name for an image size. Raises UserError for an unknown name or an impossible size."""
    if name not in LAYOUTS:
        raise problem("layout", f"one of {', '.join(LAYOUTS)}", repr(name), "correct the name")
    size, fix = f"{width}x{height}", "correct the size or the layout"
    if width < 1 or height < 1 or width * height > 1 << 26:
        raise problem(f"layout {name}", "a width and a height of a camera", size, "correct the size")
    if name == PLAIN:
        return Layout(PLAIN, width, height, bytes_per_tick(width, height))
    if name in (PADDED_ROWS, TAGGED_ROWS):
        if width % 8 or (name == TAGGED_ROWS and height < 4):  # two rows give the counter, the others confirm it
            expected = "a width that is a multiple of 8" + ", and 4 rows or more" * (name == TAGGED_ROWS)
            raise problem(f"layout {name}", expected, size, fix)
        if name == PADDED_ROWS:
            return _PaddedRows(name, width, height, height * (width // 8 + _TAG_BYTES))
        return _TaggedRows(name, width, height, height * (width // 8 + _TAG_BYTES), has_tags=True, count_tags=True)
    if width % 16 != 8 or height % 2 or height // 2 >= 1 << LINE_BITS:
        expected = f"a width of 8 more than a multiple of 16, and an even height below {2 << LINE_BITS}"
        raise problem(f"layout {name}", expected, size, fix)
    return _LineTagged(name, width, height, 2 * height * (width // 2 + LINE_BITS + 2) // 8, has_tags=True)
