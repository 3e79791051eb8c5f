"""Frame layouts: how a camera's frames lie on the wire, and how they become packed ticks.

| name | frame | what tells a torn frame | what counts frames |
|---|---|---|---|
| `plain` | the packed tick, ceil(W H / 8) bytes (400x250: 12,500) | nothing | nothing |
| `tagged-rows` | rows of W pixels and 16 tag bits (400x250: 250 rows of 52 bytes, 13,000) | tags | tags, modulo 2^32 |
| `line-tagged` | blocks of W / 2 pixels and 12 tag bits (1000x1000: 2000 of 64 bytes, 128,000) | tags | nothing |

What the cameras with rows of 416 columns write into their tags has not been published. `tagged-rows` states a rule of
our own, which the emulator follows: row r of frame n ends in the 16-bit little-endian word

    w(r) = a(r mod 2) + 257 r  (mod 2^16),    a(0) = n mod 2^16,    a(1) = (n div 2^16) + 40503 (n mod 2^16)

Every row so tells its number and, given a neighbour, the frame's: both bytes of the word grow by one from row to row,
which no image does. Two rows give n modulo 2^32 (59 hours at 20 kHz), all others confirm it. As 40503 is odd, rows of
frames n and n + m disagree with each other for every m that is no multiple of 2^16: a frame that begins with one and
ends with the other is found out, except where they meet within the first row, whose tag comes after its pixels, or,
in the dark and where that tag is zero (n a multiple of 2^16), within the second; the tick is right even then. A camera
with other tags needs another class here.

`line-tagged` is the published format of the 1000x1000 camera: a block's last word holds 4 pixels (bits 0..3), the line
1..H/2 (bits 4..13) and the channel (14..15). Blocks come as (H/2, 0), (H/2, 1), (H/2 - 1, 0) ... (1, 1), then (1, 2),
(1, 3), (2, 2) ... (H/2, 3): two make a row. This camera's images are turned by 180 degrees against the scene.

Pixels are row-major and least significant bit first in every layout, as in `benchmark/spikes/stream.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.spikes.bits import kernel, rows
from spike4dgs.benchmark.spikes.stream import bytes_per_tick

UInt8 = NDArray[np.uint8]
Int64 = NDArray[np.int64]

PLAIN, TAGGED_ROWS, LINE_TAGGED = "plain", "tagged-rows", "line-tagged"
COUNTER = 1 << 32  # frame counters count modulo this
TORN = -1
_TAG_BYTES = 2
_STEP, _MIX = 257, 40503  # of the rule above
_LINE_BITS = 10


@dataclass(frozen=True)
class Layout:
    """Frames of `frame_bytes` on the wire, of which `payload_bytes` are the packed pixels in the order of the camera.

    This one is `plain`; the others override what they do differently.
    """

    name: str
    width: int
    height: int
    frame_bytes: int

    @property
    def payload_bytes(self) -> int:
        """Bytes of one packed tick."""
        return bytes_per_tick(self.width, self.height)

    def count_tags(self) -> bool:
        """Whether every frame carries a counter."""
        return False

    def has_tags(self) -> bool:
        """Whether a frame can be found and checked by tags; without them a stream's first byte begins a frame."""
        return False

    def find(self, data: UInt8) -> int:
        """Offset of the first whole frame in a byte stream [n]; -1 where there is none. Only with tags."""
        raise ValueError(f"frames of layout {self.name} cannot be found")

    def counts(self, raw: UInt8) -> Int64:
        """Counter of each raw frame [n, frame_bytes] -> [n], 0 where the layout has none; TORN where tags disagree."""
        return np.zeros(len(raw), np.int64)

    def unpack(self, raw: UInt8, out: UInt8) -> Int64 | None:
        """Raw frames [n, frame_bytes] -> their pixels in out [n, payload_bytes], C-contiguous.

        Returns their counters [n] (TORN where a frame's tags disagree), or None where the layout has none.
        """
        np.copyto(out, raw)
        return None

    def pack(self, payload: UInt8, first_count: int = 0) -> UInt8:
        """Packed ticks [n, payload_bytes] -> raw frames [n, frame_bytes], counted from `first_count`."""
        return payload.copy()


class _TaggedRows(Layout):
    @property
    def _row_bytes(self) -> int:
        return self.width // 8 + _TAG_BYTES

    def count_tags(self) -> bool:
        return True

    def has_tags(self) -> bool:
        return True

    def find(self, data: UInt8) -> int:
        return int(_find_tagged(rows(data), self.height, self._row_bytes))

    def counts(self, raw: UInt8) -> Int64:
        out = np.empty(len(raw), np.int64)
        _count_tagged(rows(raw), self.height, self._row_bytes, out)
        return out

    def unpack(self, raw: UInt8, out: UInt8) -> Int64:
        n, pixels = len(raw), self._row_bytes - _TAG_BYTES
        target = out.view()
        target.shape = n, self.height, pixels  # never a copy
        np.copyto(target, raw.reshape(n, self.height, self._row_bytes)[:, :, :pixels])
        return self.counts(raw)

    def pack(self, payload: UInt8, first_count: int = 0) -> UInt8:
        n, pixels = len(payload), self._row_bytes - _TAG_BYTES
        raw = np.empty((n, self.height, self._row_bytes), np.uint8)
        raw[:, :, :pixels] = payload.reshape(n, self.height, pixels)
        counts = (first_count + np.arange(n)) % COUNTER
        low, high = counts % 65536, counts // 65536
        words = np.stack([low, high + _MIX * low], axis=1)[:, np.arange(self.height) % 2]  # [n, H]
        words = (words + _STEP * np.arange(self.height)) % 65536
        raw[:, :, pixels], raw[:, :, pixels + 1] = words % 256, words // 256
        return raw.reshape(n, self.frame_bytes)


class _LineTagged(Layout):
    def has_tags(self) -> bool:
        return True

    def find(self, data: UInt8) -> int:
        return int(_find_lines(rows(data), self.width, self.height))

    def counts(self, raw: UInt8) -> Int64:
        out = np.empty(len(raw), np.int64)
        _check_lines(rows(raw), self.width, self.height, out)
        return out

    def unpack(self, raw: UInt8, out: UInt8) -> None:
        _unpack_lines(rows(raw), self.width // 16, out.reshape(len(raw) * self.height, self.width // 8))

    def pack(self, payload: UInt8, first_count: int = 0) -> UInt8:
        n, half = len(payload), self.width // 2
        pixels = np.unpackbits(payload, axis=1, bitorder="little").reshape(n, 2 * self.height, half)
        tags = (_line_tags(self.height)[:, None] >> np.arange(_LINE_BITS + 2)) & 1  # [2 H, 12]
        bits = np.concatenate([pixels, np.broadcast_to(tags.astype(np.uint8), (n, *tags.shape))], axis=2)
        return np.packbits(bits.reshape(n, -1), axis=1, bitorder="little")


def make_layout(name: str, width: int, height: int) -> Layout:
    """The layout of that name for an image size. Raises UserError for an unknown name or a size it cannot have."""
    if name not in _MAKERS:
        raise problem("layout", f"one of {', '.join(_MAKERS)}", repr(name), "correct the name")
    if width < 1 or height < 1 or width * height > 1 << 26:
        raise problem(f"layout {name}", "a width and a height of a camera", f"{width}x{height}", "correct the size")
    return _MAKERS[name](width, height)


def _plain(width: int, height: int) -> Layout:
    return Layout(PLAIN, width, height, bytes_per_tick(width, height))


def _tagged_rows(width: int, height: int) -> Layout:
    if width % 8 or height < 4:  # two rows give the counter, the others confirm it
        expected = "a width that is a multiple of 8, and 4 rows or more"
        raise problem(f"layout {TAGGED_ROWS}", expected, f"{width}x{height}", "correct the size or the layout")
    return _TaggedRows(TAGGED_ROWS, width, height, height * (width // 8 + _TAG_BYTES))


def _line_tagged(width: int, height: int) -> Layout:
    if width % 16 != 8 or height % 2 or height // 2 >= 1 << _LINE_BITS:
        expected = f"a width of 8 more than a multiple of 16, and an even height below {2 << _LINE_BITS}"
        raise problem(f"layout {LINE_TAGGED}", expected, f"{width}x{height}", "correct the size or the layout")
    return _LineTagged(LINE_TAGGED, width, height, 2 * height * (width // 2 + _LINE_BITS + 2) // 8)


_MAKERS: dict[str, Callable[[int, int], Layout]] = {
    PLAIN: _plain,
    TAGGED_ROWS: _tagged_rows,
    LINE_TAGGED: _line_tagged,
}
LAYOUTS = tuple(_MAKERS)


def orient(packed: UInt8, width: int, height: int, flip: bool, mirror: bool) -> UInt8:
    """Packed ticks [n, bytes] with the rows in reverse order if `flip`, and left and right exchanged if `mirror`.

    Both together turn the image by 180 degrees. Returns `packed` itself where there is nothing to do.
    """
    if not (flip or mirror):
        return packed
    out = np.zeros(packed.shape, np.uint8)
    if width % 8 == 0:
        reverse = np.packbits(np.unpackbits(np.arange(256, dtype=np.uint8)), bitorder="little")
        _orient_bytes(rows(packed), height, flip, mirror, reverse, out)
    else:  # rows do not begin on whole bytes
        _orient_bits(rows(packed), width, height, flip, mirror, out)
    return out


@kernel
def _orient_bytes(packed: UInt8, height: int, flip: bool, mirror: bool, reverse: UInt8, out: UInt8) -> None:
    size = packed.shape[1] // height
    for t in range(len(packed)):
        for y in range(height):
            r = height - 1 - y if flip else y
            source, target = packed[t, r * size : (r + 1) * size], out[t, y * size : (y + 1) * size]
            for j in range(size):
                target[j] = reverse[source[size - 1 - j]] if mirror else source[j]


@kernel
def _orient_bits(packed: UInt8, width: int, height: int, flip: bool, mirror: bool, out: UInt8) -> None:
    for t in range(len(packed)):
        for y in range(height):
            for x in range(width):
                p = (height - 1 - y if flip else y) * width + (width - 1 - x if mirror else x)
                q = y * width + x
                out[t, q >> 3] |= ((packed[t, p >> 3] >> (p & 7)) & 1) << (q & 7)


@kernel
def _word(data: UInt8, at: int) -> int:
    """The little-endian word at data[at]; signed, because numba would make the shift of a byte unsigned."""
    return np.int64(data[at]) | np.int64(data[at + 1]) << 8  # type: ignore[return-value]


@kernel
def _tagged_count_at(data: UInt8, start: int, height: int, row_bytes: int) -> int:
    """Counter of the frame whose first byte is data[start]; TORN where its tags disagree. Its bytes are all there."""
    at = start + row_bytes - 2
    low = _word(data, at)
    at += row_bytes
    odd = (_word(data, at) - 257) & 65535
    for r in range(2, height):
        at += row_bytes
        if _word(data, at) != ((odd if r & 1 else low) + 257 * r) & 65535:
            return -1
    return low + (((odd - 40503 * low) & 65535) << 16)


@kernel
def _count_tagged(raw: UInt8, height: int, row_bytes: int, out: Int64) -> None:
    for i in range(len(raw)):
        out[i] = _tagged_count_at(raw[i], 0, height, row_bytes)


@kernel
def _find_tagged(data: UInt8, height: int, row_bytes: int) -> int:
    for start in range(len(data) - height * row_bytes + 1):
        if _tagged_count_at(data, start, height, row_bytes) >= 0:
            return start
    return -1


def _line_tags(height: int) -> Int64:
    """Line and channel (bits 0..9 and 10..11) of the blocks of a frame in their order, [2 H]."""
    row, side = np.arange(2 * height) // 2, np.arange(2 * height) % 2
    first = row < height // 2
    line = np.where(first, height // 2 - row, row - height // 2 + 1)
    return line | (np.where(first, side, 2 + side) << _LINE_BITS)


@kernel
def _lines_at(data: UInt8, start: int, width: int, height: int) -> bool:
    """Whether the blocks from data[start] on are a whole frame in their order (as `_line_tags` states it)."""
    size = (width // 2 + 12) // 8
    half = height // 2
    for b in range(2 * height):
        at = start + (b + 1) * size - 2
        row, side = b // 2, b & 1
        tag = half - row | side << 10 if row < half else row - half + 1 | (2 + side) << 10
        if _word(data, at) >> 4 != tag:
            return False
    return True


@kernel
def _check_lines(raw: UInt8, width: int, height: int, out: Int64) -> None:
    for i in range(len(raw)):
        out[i] = 0 if _lines_at(raw[i], 0, width, height) else -1


@kernel
def _find_lines(data: UInt8, width: int, height: int) -> int:
    for start in range(len(data) - 2 * height * ((width // 2 + 12) // 8) + 1):
        if _lines_at(data, start, width, height):
            return start
    return -1


@kernel
def _unpack_lines(raw: UInt8, n: int, out: UInt8) -> None:
    """Blocks of n bytes, 4 pixels and 12 tag bits -> rows of two blocks, out [frames * H, 2 n + 1]."""
    size = n + 2
    per_frame = raw.shape[1] // (2 * size)
    for i in range(len(out)):
        frame, at = raw[i // per_frame], (i % per_frame) * 2 * size
        left, right, row = frame[at : at + size], frame[at + size : at + 2 * size], out[i]
        for j in range(n):
            row[j] = left[j]
            row[n + 1 + j] = right[j] >> 4 | (right[j + 1] & 15) << 4
        row[n] = (left[n] & 15) | (right[0] & 15) << 4
