"""The matching network's weight files."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from spike4dgs.method.matching.config import CONFIGS
from spike4dgs.method.models.network_weights import ConfigCard, ConfigWeights

if TYPE_CHECKING:
    from spike4dgs.method.matching.network import Matcher

VARIABLE = "SPIKE4DGS_MATCHER"  # the environment variable that names another weight file
SHIPPED = Path(__file__).with_name("matcher.safetensors")
WEIGHTS = ConfigWeights(
    network="the matching network",
    schema="spike4dgs-matcher/1",
    card=ConfigCard,
    variable=VARIABLE,
    shipped=SHIPPED,
    command="train-msdi --config bottleneck",
    configs=CONFIGS,
)


@cache
def load_matcher(path: Path, device: str) -> Matcher:
    """Return the trained network on `device`, ready to run. Raises UserError for a damaged or foreign file."""
    from spike4dgs.method.matching.network import Matcher

    return WEIGHTS.load(path, device, lambda name: Matcher(CONFIGS[name]))
