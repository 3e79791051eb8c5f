"""The image network's weight files."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from spike4dgs.method.image_network.config import CONFIGS
from spike4dgs.method.models.network_weights import ConfigCard, ConfigWeights

if TYPE_CHECKING:
    from spike4dgs.method.image_network.network import ImageNetwork

VARIABLE = "SPIKE4DGS_IMAGES"  # the environment variable that names another weight file
SHIPPED = Path(__file__).with_name("images.safetensors")
WEIGHTS = ConfigWeights(
    network="the image network",
    schema="spike4dgs-images/1",
    card=ConfigCard,
    variable=VARIABLE,
    shipped=SHIPPED,
    command="train-msdi --config images",
    configs=CONFIGS,
)


@cache
def load_image_network(path: Path, device: str) -> ImageNetwork:
    """Return the trained network on `device`, ready to run. Raises UserError for a damaged or foreign file."""
    from spike4dgs.method.image_network.network import ImageNetwork

    return WEIGHTS.load(path, device, lambda name: ImageNetwork(CONFIGS[name]))
