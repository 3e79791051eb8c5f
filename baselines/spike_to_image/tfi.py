"""TFI, texture from inter-spike intervals: one over the interval that contains the instant."""

from __future__ import annotations

import numpy as np
from spike4dgs.baselines.spike_to_image.images import Float32, ImageMaker
from spike4dgs.benchmark.bits import kernel, rows
from spike4dgs.benchmark.spikes import SpikeStream


def tfi_image(stream: SpikeStream, tick: int) -> Float32:
    """Spikes per tick [H, W] float32 from the one interval of each pixel that contains the start of `tick`.

    A spike of tick k fires between k and k + 1, so the interval is the one from the last spike before `tick` to the
    first spike at or after it. See `tfi_stack` for pixels where one of the two is not in the clip.
    """
    image = np.empty(stream.height * stream.width, np.float32)
    _image(rows(stream.packed), tick, image)
    upright = image.reshape(stream.height, stream.width)
    return upright[::-1] if stream.rows_bottom_up else upright


@kernel
def _find(packed, pixel, tick, step):  # type: ignore[no-untyped-def]
    """The first tick with a spike, going from `tick` in direction `step`; -1 where there is none."""
    byte, bit = pixel >> 3, pixel & 7
    while 0 <= tick < len(packed):
        if packed[tick, byte] >> bit & 1:
            return tick
        tick += step
    return -1


@kernel
def _image(packed, tick, image):  # type: ignore[no-untyped-def]
    n = len(packed)
    for p in range(len(image)):
        before, after = _find(packed, p, tick - 1, -1), _find(packed, p, tick, 1)
        if before >= 0 and after >= 0:
            image[p] = 1 / (after - before)
        elif before < 0 and after < 0:
            image[p] = 0
        elif before < 0:  # the interval began before the clip: its seen part is after + 1 ticks
            following = _find(packed, p, after + 1, 1)
            image[p] = 1 / n if following < 0 else 1 / max(following - after, after + 1)
        else:
            earlier = _find(packed, p, before - 1, -1)
            image[p] = 1 / n if earlier < 0 else 1 / max(before - earlier, n - before)


TFI = ImageMaker(
    name="tfi",
    definition="1 / (the inter-spike interval that contains t)",
    source="Zhu et al., ICME 2019",
    rate=tfi_image,
)
