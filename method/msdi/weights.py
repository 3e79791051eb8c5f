"""MSDI's weight files."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from spike4dgs.method.models.network_weights import ConfigCard, ConfigWeights
from spike4dgs.method.msdi.config import CONFIGS

if TYPE_CHECKING:
    from spike4dgs.method.msdi.network import Msdi

VARIABLE = "SPIKE4DGS_MSDI"  # the environment variable that names another weight file
SHIPPED = Path(__file__).with_name("msdi-small.safetensors")


@dataclass(frozen=True)
class Card(ConfigCard):
    """The card in a weight file: where the weights come from."""

    measured: dict[str, float]  # what was measured on data that was not trained on, by name with its unit


WEIGHTS = ConfigWeights(
    network="MSDI",
    schema="spike4dgs-msdi/1",
    card=Card,
    variable=VARIABLE,
    shipped=SHIPPED,
    command="train-msdi",
    configs=CONFIGS,
)


@cache
def load_network(path: Path, device: str) -> Msdi:
    """Return the trained network on `device`, ready to run. Raises UserError for a damaged or foreign file."""
    from spike4dgs.method.msdi.network import Msdi

    return WEIGHTS.load(path, device, lambda name: Msdi(CONFIGS[name]))
