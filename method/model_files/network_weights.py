"""Weight files of the networks that are trained here: half-float safetensors that say what they were trained on."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path, sha256_file
from spike4dgs.benchmark.weights import WeightsError

if TYPE_CHECKING:
    from torch import nn

CardT = TypeVar("CardT")


@dataclass(frozen=True)
class WeightKind(Generic[CardT]):
    """What tells one network's files from another's."""

    network: str  # its name in messages
    schema: str  # the only key of the metadata: two would be written in any order
    card: type[CardT]  # dataclass of plain values, and the tuple `trained_on`: where weights come from
    variable: str  # the environment variable that names a file in place of the shipped one
    command: str  # what trains it

    @property
    def fix(self) -> str:
        """What to do about a file that is missing, damaged or foreign."""
        return f"train it with `spike4dgs {self.command}`, or set {self.variable} to a file that this command wrote"


def weights_in_use(kind: WeightKind[Any], shipped: Path) -> Path:
    """The weight file in use: what the environment variable names, else the one that is shipped.

    Raises WeightsError where there is no such file.
    """
    path = Path(os.environ.get(kind.variable) or shipped)
    if not path.is_file():
        missing = problem(path, f"weights of {kind.network}", "no such file", kind.fix)
        raise WeightsError(str(missing), f"no trained weights {path.name}: {kind.fix}")
    return path


def write_weights(kind: WeightKind[CardT], path: Path, network: nn.Module, card: CardT) -> str:
    """Write the network's parameters as half floats, atomically, and return the file's SHA-256.

    Raises UserError where a parameter is not finite as a half float: the file would give NaN.
    """
    import safetensors.torch
    import torch

    tensors = {k: v.detach().to("cpu", torch.float16).contiguous() for k, v in network.state_dict().items()}
    if bad := [name for name, tensor in tensors.items() if not tensor.isfinite().all()]:
        raise problem(path, "finite parameters", f"NaN or more than 65504 in {bad[0]}", "go back to an earlier step")
    fields: dict[str, Any] = asdict(card)  # type: ignore[call-overload]
    with atomic_path(path) as part:
        safetensors.torch.save_file(tensors, part, metadata={kind.schema: json.dumps(fields, sort_keys=True)})
    return sha256_file(path)


def read_weights_card(kind: WeightKind[CardT], path: Path) -> CardT:
    """What the file says of itself. Raises UserError for a damaged or foreign file. torch is not imported."""
    import safetensors

    try:
        with safetensors.safe_open(path, framework="np") as f:
            meta = f.metadata() or {}
        if kind.schema not in meta:
            raise problem(path, f"metadata {kind.schema}", ", ".join(meta) or "none", kind.fix)
        fields: dict[str, Any] = json.loads(meta[kind.schema])
        return kind.card(**{**fields, "trained_on": tuple(fields["trained_on"])})
    except (safetensors.SafetensorError, OSError, LookupError, TypeError, ValueError) as e:
        raise problem(path, f"weights of {kind.network}", f"damaged data ({e})", kind.fix) from None


def fill_network(kind: WeightKind[Any], path: Path, network: nn.Module, shape: str) -> None:
    """Give `network`, which may be on torch's device `meta`, the file's parameters as float32 on the CPU.

    It is left ready to run, without gradients. Raises UserError where the file is damaged or its tensors are not those
    of a network of this `shape`, such as "width 8".
    """
    import safetensors.torch

    try:
        state = {name: tensor.float() for name, tensor in safetensors.torch.load_file(path).items()}
        network.load_state_dict(state, assign=True)
    except (safetensors.SafetensorError, RuntimeError) as e:
        found = f"damaged data ({str(e).splitlines()[0]})"
        raise problem(path, f"parameters of {shape}", found, kind.fix) from None
    network.requires_grad_(False).eval()
