"""Weight files of MSDI: half-float safetensors that say what they were trained on."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path, sha256_file
from spike4dgs.benchmark.weights import WeightsError
from spike4dgs.method.msdi.config import CONFIGS

if TYPE_CHECKING:
    from spike4dgs.method.msdi.network import Msdi

VARIABLE = "SPIKE4DGS_MSDI"  # the environment variable that names another weight file
SHIPPED = Path(__file__).with_name("msdi-small.safetensors")
_SCHEMA = "spike4dgs-msdi/1"  # the only key of the metadata: two would be written in any order
_FIX = f"train it with `spike4dgs train-msdi`, or set {VARIABLE} to a file that this command wrote"


@dataclass(frozen=True)
class Card:
    """Where weights come from."""

    config: str  # name of the configuration
    steps: int
    seed: int
    trained_on: tuple[str, ...]  # scenes, as ID@REVISION, or what else was rendered for training
    measured: dict[str, float]  # what was measured on data that was not trained on, by name with its unit


def weights_path() -> Path:
    """The weight file in use: what the environment variable SPIKE4DGS_MSDI names, else the one that is shipped.

    Raises WeightsError where there is no such file.
    """
    path = Path(os.environ.get(VARIABLE) or SHIPPED)
    if not path.is_file():
        missing = problem(path, "weights of MSDI", "no such file", _FIX)
        raise WeightsError(str(missing), f"no trained weights {path.name}: {_FIX}")
    return path


def save_weights(path: Path, network: Msdi, card: Card) -> str:
    """Write the network's parameters as half floats, atomically, and return the file's SHA-256.

    Raises UserError where a parameter is not finite as a half float: the file would give NaN.
    """
    import safetensors.torch
    import torch

    tensors = {k: v.detach().to("cpu", torch.float16).contiguous() for k, v in network.state_dict().items()}
    if bad := [name for name, tensor in tensors.items() if not tensor.isfinite().all()]:
        raise problem(path, "finite parameters", f"NaN or more than 65504 in {bad[0]}", "go back to an earlier step")
    with atomic_path(path) as part:
        safetensors.torch.save_file(tensors, part, metadata={_SCHEMA: json.dumps(asdict(card), sort_keys=True)})
    return sha256_file(path)


def read_card(path: Path) -> Card:
    """What the file says of itself. Raises UserError for a damaged or foreign file."""
    import safetensors

    try:
        with safetensors.safe_open(path, framework="np") as f:
            meta = f.metadata() or {}
        if _SCHEMA not in meta:
            raise problem(path, f"metadata {_SCHEMA}", ", ".join(meta) or "none", _FIX)
        fields: dict[str, Any] = json.loads(meta[_SCHEMA])
        card = Card(**{**fields, "trained_on": tuple(fields["trained_on"])})
    except (safetensors.SafetensorError, OSError, LookupError, TypeError, ValueError) as e:
        raise problem(path, "weights of MSDI", f"damaged data ({e})", _FIX) from None
    if card.config not in CONFIGS:
        raise problem(path, f"a configuration of {', '.join(CONFIGS)}", repr(card.config), _FIX)
    return card


@cache
def load_network(path: Path, device: str) -> Msdi:
    """The trained network on `device`, ready to run. Raises UserError for a damaged or foreign file."""
    import safetensors.torch
    import torch

    from spike4dgs.method.msdi.network import Msdi

    config = CONFIGS[read_card(path).config]
    with torch.device("meta"):  # parameters need not be drawn at random first
        network = Msdi(config)
    try:
        state = {name: tensor.float() for name, tensor in safetensors.torch.load_file(path).items()}
        network.load_state_dict(state, assign=True)
    except (safetensors.SafetensorError, RuntimeError) as e:
        found = f"damaged data ({str(e).splitlines()[0]})"
        raise problem(path, f"parameters of configuration {config.name}", found, _FIX) from None
    return network.requires_grad_(False).eval().to(device)
