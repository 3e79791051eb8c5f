"""MSDI's weight files."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from spike4dgs.benchmark.errors import problem
from spike4dgs.method.models.network_weights import WeightKind, fill_network, read_weights_card, write_weights
from spike4dgs.method.msdi.config import CONFIGS

if TYPE_CHECKING:
    from spike4dgs.method.msdi.network import Msdi

VARIABLE = "SPIKE4DGS_MSDI"  # the environment variable that names another weight file
SHIPPED = Path(__file__).with_name("msdi-small.safetensors")


@dataclass(frozen=True)
class Card:
    """The card in a weight file: where the weights come from."""

    config: str  # name of the configuration
    steps: int
    seed: int
    trained_on: tuple[str, ...]  # scenes, as ID@REVISION, or what else was rendered for training
    measured: dict[str, float]  # what was measured on data that was not trained on, by name with its unit


WEIGHTS = WeightKind(
    network="MSDI",
    schema="spike4dgs-msdi/1",
    card=Card,
    variable=VARIABLE,
    shipped=SHIPPED,
    command="train-msdi",
)


def weights_path() -> Path:
    """Return the weight file in use: what the environment variable SPIKE4DGS_MSDI names, else the shipped one.

    Raises WeightsError where there is no such file.
    """
    return WEIGHTS.in_use().path


def save_weights(path: Path, network: Msdi, card: Card) -> str:
    """Write the network's parameters as half floats, atomically, and return the file's SHA-256.

    Raises UserError where a parameter is not finite as a half float.
    """
    return write_weights(WEIGHTS, path, network, card)


def read_card(path: Path) -> Card:
    """Return the file's card. Raises UserError for a damaged or foreign file."""
    card = read_weights_card(WEIGHTS, path)
    if card.config not in CONFIGS:
        raise problem(path, f"a configuration of {', '.join(CONFIGS)}", repr(card.config), WEIGHTS.fix)
    return card


def check_weights() -> Path:
    """Return the weight file in use, its card read. Raises UserError where it is missing, damaged or foreign."""
    path = weights_path()
    read_card(path)
    return path


@cache
def load_network(path: Path, device: str) -> Msdi:
    """Return the trained network on `device`, ready to run. Raises UserError for a damaged or foreign file."""
    import torch

    from spike4dgs.method.msdi.network import Msdi

    config = CONFIGS[read_card(path).config]
    with torch.device("meta"):  # parameters need not be drawn at random first
        network = Msdi(config)
    return fill_network(WEIGHTS, path, network, f"configuration {config.name}").to(device)
