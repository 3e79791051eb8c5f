"""The image maker `msdi`: MSDI's image network at an instant, view by view."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.image_network.inputs import image_inputs
from spike4dgs.method.image_network.weights import WEIGHTS, load_image_network
from spike4dgs.method.images.base import ImageMaker, learned_from

if TYPE_CHECKING:
    from spike4dgs.method.image_network.network import ImageNetwork


def msdi_image(stream: SpikeStream, tick: int, camera: Calibration | None = None, device: str = "auto") -> Float32:
    """Return spikes per tick [H, W] float32 at the start of `tick`, by the network in use.

    With a calibration they are those of an ideal camera. Beyond its ends the clip is mirrored. Raises UserError where
    the weights are missing or damaged.
    """
    chosen = choose_device(device, rasterizes=False)
    return reconstruct(load_image_network(WEIGHTS.in_use().path, chosen), stream, tick, camera)


def reconstruct(network: ImageNetwork, stream: SpikeStream, tick: int, camera: Calibration | None = None) -> Float32:
    """Return the estimate of `network` at the start of `tick`: spikes per tick [H, W] float32, not negative."""
    import torch  # imported where it is used: reading spikes must not wait for it

    from spike4dgs.method.image_network.network import rate_of
    from spike4dgs.method.msdi.network import has_bfloat16

    device = next(network.parameters()).device
    of_pixels = camera is None or camera.of_pixels
    found = image_inputs(stream, tick, (camera.gain, camera.dark) if camera else None, of_pixels)
    with torch.inference_mode(), torch.autocast(device.type, torch.bfloat16, enabled=has_bfloat16(device)):
        channels, spikes = (torch.from_numpy(a).to(device)[None] for a in (found.channels, found.spikes))
        rate = rate_of(network(channels, spikes)[0], found.unit).cpu().numpy()
    return np.asarray(rate, np.float32)


def msdi_maker(device: str) -> ImageMaker:
    """Return the image maker whose network runs on `device`."""
    return ImageMaker(
        name="msdi",
        definition="MSDI's image network: adaptive's windows and the 41 ticks around tick t",
        source="this project, in the place of Spike4DGS's eq. 12",
        rate=lambda stream, tick, _: msdi_image(stream, tick, device=device),
        learned=partial(learned_from, WEIGHTS.in_use, WEIGHTS.read_card),
        corrected=partial(msdi_image, device=device),
        made_on=msdi_maker,
        label="by MSDI",
    )


MSDI = msdi_maker("auto")
