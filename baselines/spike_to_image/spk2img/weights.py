"""Spk2ImgNet's weight files."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from spike4dgs.method.model_files.network_weights import (
    WeightKind,
    fill_network,
    read_weights_card,
    weights_in_use,
    write_weights,
)

if TYPE_CHECKING:
    from spike4dgs.baselines.spike_to_image.spk2img.network import Spk2ImgNet

VARIABLE = "SPIKE4DGS_SPK2IMG"  # the environment variable that names another weight file
SHIPPED = Path(__file__).with_name("spk2img-8.safetensors")


@dataclass(frozen=True)
class Card:
    """Where weights come from."""

    width: int
    steps: int
    seed: int
    trained_on: tuple[str, ...]  # scenes, as ID@REVISION
    hidden_psnr_db: dict[str, float]  # scene that was not trained on -> mean over its targets


_KIND = WeightKind("Spk2ImgNet", "spike4dgs-spk2img/1", Card, VARIABLE, "train-spk2img")


def weights_path() -> Path:
    """The weight file in use: what the environment variable SPIKE4DGS_SPK2IMG names, else the one that is shipped.

    Raises WeightsError where there is no such file.
    """
    return weights_in_use(_KIND, SHIPPED)


def save_weights(path: Path, network: Spk2ImgNet, card: Card) -> str:
    """Write the network's parameters as half floats, atomically, and return the file's SHA-256.

    Raises UserError where a parameter is not finite as a half float.
    """
    return write_weights(_KIND, path, network, card)


def read_card(path: Path) -> Card:
    """What the file says of itself. Raises UserError for a damaged or foreign file."""
    return read_weights_card(_KIND, path)


@cache
def load_network(path: Path, device: str) -> Spk2ImgNet:
    """The trained network on `device`, ready to run. Raises UserError for a damaged or foreign file."""
    from spike4dgs.baselines.spike_to_image.spk2img.network import Spk2ImgNet, place

    network = Spk2ImgNet(read_card(path).width)
    fill_network(_KIND, path, network, f"width {network.width}")
    return place(network, device)
