"""The image maker `spk2img`: Spk2ImgNet with the weights in use."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from spike4dgs.baselines.spike_to_image.base import Float32, ImageMaker, NetworkSettings, learned_from
from spike4dgs.baselines.spike_to_image.spk2img.weights import WEIGHTS, load_network, read_card, weights_path
from spike4dgs.baselines.spike_to_image.windows import WINDOW, window
from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.spikes.stream import SpikeStream

if TYPE_CHECKING:
    from spike4dgs.baselines.spike_to_image.spk2img.network import Spk2ImgNet


def spk2img_image(stream: SpikeStream, tick: int, settings: NetworkSettings) -> Float32:
    """Return spikes per tick [H, W] float32 at the start of `tick`, by the network in use.

    Beyond its ends the clip is mirrored. Raises UserError where the weights are missing or damaged.
    """
    return reconstruct(load_network(weights_path(), choose_device(settings.device, rasterizes=False)), stream, tick)


def reconstruct(network: Spk2ImgNet, stream: SpikeStream, tick: int) -> Float32:
    """Return the estimate of `network` at the start of `tick`: spikes per tick [H, W] float32, not negative."""
    import torch  # imported where it is used: reading spikes must not wait for it

    device = next(network.parameters()).device
    with torch.inference_mode():
        spikes = torch.from_numpy(window(stream, tick)).to(device, torch.float32)[None]
        spikes = spikes.contiguous(memory_format=torch.channels_last)
        rate: Float32 = network(spikes).rate[0].clamp(min=0).cpu().numpy()
    return rate


SPK2IMG = ImageMaker(
    name="spk2img",
    definition=f"Spk2ImgNet on the {WINDOW} ticks around tick t",
    source="Zhao, Xiong, Liu, Huang: Spk2ImgNet: learning to reconstruct dynamic scene from continuous spike stream, "
    "CVPR 2021",
    rate=spk2img_image,
    settings=NetworkSettings(),
    learned=partial(learned_from, WEIGHTS.in_use, read_card),
)
