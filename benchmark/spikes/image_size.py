"""Which width and height a headerless stream has: by its length, and by how far neighbouring rows agree.

Light changes little from a pixel to the one below it. So along the pixels of a tick, in the order of the file, the
rates of pixels one true row apart are alike. At a wrong width they are of places far from each other: the image shears.
"""

from __future__ import annotations

import numpy as np

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.spikes.stream import SpikeStream, bytes_per_tick, count_bits

Size = tuple[int, int]  # width, height

# Of spike cameras, and of the raw dumps of the first, whose rows end in 16 bits of no pixel; then of the scenes of
# `make-dataset`.
KNOWN_SIZES: tuple[Size, ...] = ((400, 250), (416, 250), (1000, 1000), (200, 125), (64, 40))
_TICKS = 256  # from the middle of the clip: enough to know rates, too few for most things to move far
_MOST_ASPECT = 4.0  # of the sizes that are tried, either way
_FEWEST = 16  # pixels of a side of such a size
ALIKE = 0.5  # correlation of neighbouring rows below which no size is proposed
_BETTER = 0.5  # what is missing from a correlation of 1 falls at least to this share


def fitting_sizes(data: UInt8) -> list[Size]:
    """Return the known sizes that a file's bytes [n] are whole ticks of; those whose rows agree best come first."""
    sizes = [size for size in KNOWN_SIZES if len(data) and len(data) % bytes_per_tick(*size) == 0]
    return sorted(sizes, key=lambda size: -row_agreement(data, size))


def row_agreement(data: UInt8, size: Size) -> float:
    """Return the correlation, -1 to 1, of the rates of pixels one row apart; 0 where all rates are the same.

    `data` are a file's bytes [n], whole ticks of that size.
    """
    width, height = size
    packed = data.reshape(-1, bytes_per_tick(width, height))
    start = max(0, (len(packed) - _TICKS) // 2)
    rates = count_bits(packed[start : start + _TICKS], width * height).astype(np.float64)
    above, below = rates[:-width], rates[width:]
    above, below = above - above.mean(), below - below.mean()
    scale = float(np.sqrt((above @ above) * (below @ below)))
    return float(above @ below) / scale if scale > 0 else 0.0


def size_doubt(stream: SpikeStream) -> str | None:
    """Return one line that proposes another size, where the rows of a stream agree far better at it; else None."""
    data, size = stream.packed.reshape(-1), (stream.width, stream.height)
    if stream.height < 2:
        return None
    given = row_agreement(data, size)
    found = {other: row_agreement(data, other) for other in _other_sizes(len(data), size)}
    best = max(found, key=lambda other: found[other], default=None)
    if best is None or found[best] < ALIKE or 1 - found[best] > _BETTER * (1 - given):
        return None
    return (
        f"{stream.source}: neighbouring rows of {size[0]}x{size[1]} pixels do not match (correlation {given:.2f}, "
        f"at {best[0]}x{best[1]} it is {found[best]:.2f}); try --width {best[0]} --height {best[1]}"
    )


def _other_sizes(n_bytes: int, size: Size) -> set[Size]:
    """Return the known sizes that fit, and those of as many pixels. A multiple of the width skips rows, which proves
    nothing: a sensor's rows may differ in turn."""
    width, height = size
    known = {other for other in KNOWN_SIZES if n_bytes % bytes_per_tick(*other) == 0}
    shapes = [
        (w, width * height // w) for w in range(_FEWEST, width * height // _FEWEST + 1) if width * height % w == 0
    ]
    same = {(w, h) for w, h in shapes if w % width and max(w / h, h / w) <= _MOST_ASPECT}
    return (known | same | ({(height, width)} if height > 1 else set())) - {size, (width * height, 1)}
