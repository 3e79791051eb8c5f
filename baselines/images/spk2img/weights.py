"""Spk2ImgNet's weight files."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from spike4dgs.method.models.network_weights import WeightKind, fill_network, read_weights_card, write_weights

if TYPE_CHECKING:
    from spike4dgs.baselines.images.spk2img.network import Spk2ImgNet

VARIABLE = "SPIKE4DGS_SPK2IMG"  # the environment variable that names another weight file
SHIPPED = Path(__file__).with_name("spk2img-8.safetensors")


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
    variable=VARIABLE,
    shipped=SHIPPED,
    command="train-spk2img",
)


def weights_path() -> Path:
    """Return the weight file in use: what the environment variable SPIKE4DGS_SPK2IMG names, else the shipped one.

    Raises WeightsError where there is no such file.
    """
    return WEIGHTS.in_use().path


def save_weights(path: Path, network: Spk2ImgNet, card: Card) -> str:
    """Write the network's parameters as half floats, atomically, and return the file's SHA-256.

    Raises UserError where a parameter is not finite as a half float.
    """
    return write_weights(WEIGHTS, path, network, card)


def read_card(path: Path) -> Card:
    """Return the file's card. Raises UserError for a damaged or foreign file."""
    return read_weights_card(WEIGHTS, path)


def check_weights() -> Path:
    """Return the weight file in use, its card read. Raises UserError where it is missing, damaged or foreign."""
    path = weights_path()
    read_card(path)
    return path


@cache
def load_network(path: Path, device: str) -> Spk2ImgNet:
    """Return the trained network on `device`, ready to run. Raises UserError for a damaged or foreign file."""
    from spike4dgs.baselines.images.spk2img.network import Spk2ImgNet, on_device

    network = Spk2ImgNet(read_card(path).width)
    return on_device(fill_network(WEIGHTS, path, network, f"width {network.width}"), device)
