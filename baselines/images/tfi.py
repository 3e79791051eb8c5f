"""TFI, texture from inter-spike intervals: one over the interval that contains the instant.

A spike of tick k fires between the instants k and k + 1, so the interval that contains the start of tick t runs from
the last spike before t to the first spike at or after t; over it the pixel has collected one spike's worth of light.
Spikes are known to the tick, so an interval of k ticks was k - 1 to k + 1 long; plain 1 / k is the field's choice, and
its mean over time is the spike rate.

There is no limit to the search, so dark pixels get their rate and not a floor. Where the interval reaches over an end
of the clip, the pixel takes the nearest complete interval, or the part of its own that lies in the clip if that is
longer; with one spike in the whole clip it is 1 / (length of the clip), the mean rate; with none it is 0.
"""

from __future__ import annotations

import numpy as np

from spike4dgs.benchmark.arrays import Float32, UInt8
from spike4dgs.benchmark.spikes.bits import find_spike, in_threads, kernel, rows
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.images.base import ImageMaker


def tfi_image(stream: SpikeStream, tick: int) -> Float32:
    """Return spikes per tick [H, W] float32: 1 / the interval of each pixel that contains the start of `tick`."""
    image = np.empty(stream.height * stream.width, np.float32)
    in_threads(_image, len(image), rows(stream.packed), tick, image, small=len(image) < 1 << 14)
    upright = image.reshape(stream.height, stream.width)
    return upright[::-1] if stream.rows_bottom_up else upright


@kernel
def _image(packed: UInt8, tick: int, image: Float32, start: int, stop: int) -> None:
    n = len(packed)
    for p in range(start, stop):
        before, after = find_spike(packed, p, tick - 1, -1), find_spike(packed, p, tick, 1)
        if before >= 0 and after >= 0:
            length = after - before
        elif after >= 0:
            following = find_spike(packed, p, after + 1, 1)
            length = n if following < 0 else max(following - after, after + 1)
        elif before >= 0:
            earlier = find_spike(packed, p, before - 1, -1)
            length = n if earlier < 0 else max(before - earlier, n - before)
        image[p] = np.float32(1) / np.float32(length) if before >= 0 or after >= 0 else np.float32(0)


TFI = ImageMaker(
    name="tfi",
    definition="1 / (the inter-spike interval that contains the start of tick t)",
    source="Zhu, Dong, Huang, Tian: A retina-inspired sampling method for visual texture reconstruction, ICME 2019",
    rate=lambda stream, tick, _: tfi_image(stream, tick),
    label="from spike intervals",
)
