"""The image maker `spk2img`: Spk2ImgNet with the weights in use."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.images.base import WINDOW, ImageMaker, learned_from, window
from spike4dgs.method.models.network_weights import WeightKind

if TYPE_CHECKING:
    from spike4dgs.baselines.images.spk2img.network import Spk2ImgNet


@dataclass(frozen=True)
class Card:
    """The card in a weight file: where the weights come from."""

    width: int
    steps: int
    seed: int
    trained_on: tuple[str, ...]  # scenes, as ID@REVISION
    hidden_psnr_db: dict[str, float]  # scene that was not trained on -> mean over its targets


WEIGHTS = WeightKind(
    network="Spk2ImgNet",
    schema="spike4dgs-spk2img/1",
    card=Card,
    variable="SPIKE4DGS_SPK2IMG",
    shipped=Path(__file__).with_name("spk2img-8.safetensors"),
    command="train-spk2img",
)


@cache
def load_network(path: Path, device: str) -> Spk2ImgNet:
    """Return the trained network on `device`, ready to run. Raises UserError for a damaged or foreign file."""
    from spike4dgs.baselines.images.spk2img.network import Spk2ImgNet, on_device

    network = Spk2ImgNet(WEIGHTS.read_card(path).width)
    return on_device(WEIGHTS.fill(path, network, f"width {network.width}"), device)


def spk2img_image(stream: SpikeStream, tick: int, device: str = "auto") -> Float32:
    """Return spikes per tick [H, W] float32 at the start of `tick`, by the network in use.

    Beyond its ends the clip is mirrored. Raises UserError where the weights are missing or damaged.
    """
    return reconstruct(load_network(WEIGHTS.in_use().path, choose_device(device, rasterizes=False)), stream, tick)


def reconstruct(network: Spk2ImgNet, stream: SpikeStream, tick: int) -> Float32:
    """Return the estimate of `network` at the start of `tick`: spikes per tick [H, W] float32, not negative."""
    import torch  # imported where it is used: reading spikes must not wait for it

    device = next(network.parameters()).device
    with torch.inference_mode():
        spikes = torch.from_numpy(window(stream, tick)).to(device, torch.float32)[None]
        spikes = spikes.contiguous(memory_format=torch.channels_last)
        rate: Float32 = network(spikes).rate[0].clamp(min=0).cpu().numpy()
    return rate


def spk2img_maker(device: str) -> ImageMaker:
    """Return the image maker whose network runs on `device`."""
    return ImageMaker(
        name="spk2img",
        definition=f"Spk2ImgNet on the {WINDOW} ticks around tick t",
        source="Zhao, Xiong, Liu, Huang: Spk2ImgNet: learning to reconstruct dynamic scene from continuous spike "
        "stream, CVPR 2021",
        rate=lambda stream, tick, _: spk2img_image(stream, tick, device),
        learned=partial(learned_from, WEIGHTS.in_use, WEIGHTS.read_card),
        without_dark=True,
        made_on=spk2img_maker,
        label="by Spk2ImgNet",
    )


SPK2IMG = spk2img_maker("auto")
