"""A short animation of one view in slow motion: radiance on the left, the counts of its spikes on the right."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.generators.sensor.model import Float32

_FRAMES, _FRAME_MS, _QUALITY = 45, 60, 35
_WINDOW = 16  # ticks of a count image


def preview(
    keys: Sequence[Float32], key_ticks: Sequence[int], stream: SpikeStream, radiance_gain: float, path: Path
) -> None:
    """Write an endless WebP of about 45 frames. `keys` are radiance [H, W] at `key_ticks`; equal input, equal bytes."""
    from PIL import Image

    last = stream.n_ticks - _WINDOW
    inside = [k for k, tick in enumerate(key_ticks) if tick <= last]
    chosen = inside[:: max(1, round(len(inside) / _FRAMES))]
    frames = []
    for k in chosen:
        counts = stream.counts(int(key_ticks[k]), int(key_ticks[k]) + _WINDOW) / (_WINDOW * radiance_gain)
        both = np.concatenate([np.asarray(keys[k]), counts.astype(np.float32)], axis=1)
        frames.append(Image.fromarray(encode_srgb(both)).convert("RGB"))
    with atomic_path(path) as part:
        frames[0].save(
            part, save_all=True, append_images=frames[1:], duration=_FRAME_MS, loop=0, quality=_QUALITY, method=4
        )
