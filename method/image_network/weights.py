"""The image network's weight files."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from spike4dgs.benchmark.errors import problem
from spike4dgs.method.image_network.config import CONFIGS
from spike4dgs.method.models.network_weights import WeightKind

if TYPE_CHECKING:
    from spike4dgs.method.image_network.network import ImageNetwork

VARIABLE = "SPIKE4DGS_IMAGES"  # the environment variable that names another weight file
SHIPPED = Path(__file__).with_name("images.safetensors")


@dataclass(frozen=True)
class ImageCard:
    """The card in a weight file: where the weights come from."""

    config: str  # name of the configuration
    steps: int
    seed: int
    trained_on: tuple[str, ...]  # shards, as ID@SHA256


def _check_card(card: ImageCard, path: Path) -> None:
    if card.config not in CONFIGS:
        raise problem(path, f"a configuration of {', '.join(CONFIGS)}", repr(card.config), WEIGHTS.fix)


WEIGHTS = WeightKind(
    network="the image network",
    schema="spike4dgs-images/1",
    card=ImageCard,
    variable=VARIABLE,
    shipped=SHIPPED,
    command="train-msdi --config images",
    check_card=_check_card,
)


@cache
def load_image_network(path: Path, device: str) -> ImageNetwork:
    """Return the trained network on `device`, ready to run. Raises UserError for a damaged or foreign file."""
    import torch

    from spike4dgs.method.image_network.network import ImageNetwork

    config = CONFIGS[WEIGHTS.read_card(path).config]
    with torch.device("meta"):  # parameters need not be drawn at random first
        network = ImageNetwork(config)
    return WEIGHTS.fill(path, network, f"configuration {config.name}").to(device)
