"""Weight files of Spk2ImgNet: half-float safetensors that say what they were trained on."""

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

if TYPE_CHECKING:
    from spike4dgs.baselines.spike_to_image.spk2img.network import Spk2ImgNet

VARIABLE = "SPIKE4DGS_SPK2IMG"  # the environment variable that names another weight file
SHIPPED = Path(__file__).with_name("spk2img-8.safetensors")
_SCHEMA = "spike4dgs-spk2img/1"  # the only key of the metadata: two would be written in any order
_FIX = f"train it with `spike4dgs train-spk2img`, or set {VARIABLE} to a file that this command wrote"


@dataclass(frozen=True)
class Card:
    """Where weights come from."""

    width: int
    steps: int
    seed: int
    trained_on: tuple[str, ...]  # scenes, as ID@REVISION
    hidden_psnr_db: dict[str, float]  # scene that was not trained on -> mean over its targets


def weights_path() -> Path:
    """The weight file in use: what the environment variable SPIKE4DGS_SPK2IMG names, else the one that is shipped.

    Raises WeightsError where there is no such file.
    """
    path = Path(os.environ.get(VARIABLE) or SHIPPED)
    if not path.is_file():
        missing = problem(path, "weights of Spk2ImgNet", "no such file", _FIX)
        raise WeightsError(str(missing), f"no trained weights {path.name}: {_FIX}")
    return path


def save_weights(path: Path, network: Spk2ImgNet, card: Card) -> str:
    """Write the network's parameters as half floats, atomically, and return the file's SHA-256."""
    import safetensors.torch
    import torch

    tensors = {k: v.detach().to("cpu", torch.float16).contiguous() for k, v in network.state_dict().items()}
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
        return Card(**{**fields, "trained_on": tuple(fields["trained_on"])})
    except (safetensors.SafetensorError, OSError, LookupError, TypeError, ValueError) as e:
        raise problem(path, "weights of Spk2ImgNet", f"damaged data ({e})", _FIX) from None


@cache
def load_network(path: Path, device: str) -> Spk2ImgNet:
    """The trained network on `device`, ready to run. Raises UserError for a damaged or foreign file."""
    import safetensors.torch

    from spike4dgs.baselines.spike_to_image.spk2img.network import Spk2ImgNet, place

    network = Spk2ImgNet(read_card(path).width)
    try:
        network.load_state_dict(safetensors.torch.load_file(path))
    except (safetensors.SafetensorError, RuntimeError) as e:
        found = f"damaged data ({str(e).splitlines()[0]})"
        raise problem(path, f"parameters of width {network.width}", found, _FIX) from None
    network.requires_grad_(False)
    return place(network, device)
