"""MSDI's weight files."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from spike4dgs.benchmark.errors import problem
from spike4dgs.method.models.network_weights import WeightKind
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


def _check_card(card: Card, path: Path) -> None:
    if card.config not in CONFIGS:
        raise problem(path, f"a configuration of {', '.join(CONFIGS)}", repr(card.config), WEIGHTS.fix)


WEIGHTS = WeightKind(
    network="MSDI",
    schema="spike4dgs-msdi/1",
    card=Card,
    variable=VARIABLE,
    shipped=SHIPPED,
    command="train-msdi",
    check_card=_check_card,
)


@cache
def load_network(path: Path, device: str) -> Msdi:
    """Return the trained network on `device`, ready to run. Raises UserError for a damaged or foreign file."""
    import torch

    from spike4dgs.method.msdi.network import Msdi

    config = CONFIGS[WEIGHTS.read_card(path).config]
    with torch.device("meta"):  # parameters need not be drawn at random first
        network = Msdi(config)
    return WEIGHTS.fill(path, network, f"configuration {config.name}").to(device)
