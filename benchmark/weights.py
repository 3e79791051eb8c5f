"""Weight files: where they lie, proof that they are the right ones, and their tensors.

A part that needs weights states its facts, as a `WeightFile` or a `NamedWeights`, and the rest is done here:

    find_weights(facts)                                  the file, its hash checked
    read_header(path, ...), read_tensors(path, ...)      its metadata; its tensors
    load_into(network, tensors, path)                    the network with them, ready to run

Nothing is downloaded here (`spike4dgs download weights` does that), and no code of a file runs. Files are hashed once
per process; torch hub does not hash files that it has already.
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import sha256_file
from spike4dgs.benchmark.untrusted import check_header

if TYPE_CHECKING:  # torch takes seconds to import and is needed only where there are weights
    from torch import Tensor, nn

    NetworkT = TypeVar("NetworkT", bound=nn.Module)

VARIABLE = "SPIKE4DGS_WEIGHTS"
_DAMAGED = (RuntimeError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, AssertionError)
TORCHVISION = "https://download.pytorch.org/models/"
_TORCHVISION_LICENCE = "BSD-3-Clause (torchvision); trained on ImageNet, whose terms are for non-commercial research"


@dataclass(frozen=True)
class WeightFile:
    """A file that users bring, found by its name: in the folder (or beside the file) that the environment variable
    SPIKE4DGS_WEIGHTS names, else in torch hub's folder.

    Without `sha256` any file of that name is taken, and its hash is recorded.
    """

    name: str
    bytes: int | None
    sha256: str | None
    purpose: str
    source: str  # where users find it
    licence: str = "not stated"
    remote_name: str | None = None  # its name at the source, where that is another one
    command: str = ""  # of spike4dgs, that fetches it; none where the source is a page for people

    @property
    def address(self) -> tuple[str, str] | None:
        """The folder and the name that it can be fetched by; None where the source is a page for people."""
        folder, _, name = self.source.rpartition("/")
        return (folder, name) if name == (self.remote_name or self.name) else None

    @property
    def description(self) -> str:
        """Name, size, hash and purpose in one phrase."""
        size = f"{self.bytes} bytes" if self.bytes else "any size"
        return f"{self.name} ({self.purpose}; {size}, sha256 {self.sha256 or 'not fixed'})"

    @property
    def need(self) -> str:
        """The reason of a missing value in a record, without paths of this machine."""
        return f"needs the file {self.description}, which is not on this machine"

    @property
    def fix(self) -> str:
        """The advice where the file is missing."""
        if self.command:
            way = f"run `spike4dgs {self.command}`, or get it from {self.source} and put it there"
        else:
            way = f"save the state dict of the network of {self.source} as {self.name} there"
        return f"{way}, or set {VARIABLE} to the folder that holds it"

    @property
    def candidates(self) -> list[Path]:
        """The paths where the file may lie; the first that exists counts."""
        given = _given(VARIABLE)
        folders = [hub_folder()]
        if given is not None:
            folders.insert(0, given.parent if given.is_file() else given)
        return [folder / self.name for folder in folders]


@dataclass(frozen=True)
class NamedWeights:
    """The one file that an environment variable names, whatever it is called, or else the shipped one, if any."""

    description: str
    variable: str
    fix: str  # the advice where the file is missing
    shipped: Path | None = None
    download: WeightFile | None = None  # what `spike4dgs download weights` fetches; found where it puts it

    @property
    def need(self) -> str:
        """The reason of a missing value in a record, without paths of this machine."""
        return f"needs {self.description}: {self.fix}"

    @property
    def candidates(self) -> list[Path]:
        """The path where the file lies. The shipped file never takes the place of one that was asked for."""
        path = _given(self.variable) or self.shipped
        if path is None and self.download is not None:
            return [found for found in self.download.candidates if found.is_file()][:1]
        return [] if path is None else [path]


@dataclass(frozen=True)
class FoundWeights:
    """A weight file on this machine."""

    path: Path

    @property
    def sha256(self) -> str:
        """The file's hash, computed once as long as size and time of change stay."""
        status = self.path.stat()
        return _sha256(self.path, status.st_size, status.st_mtime_ns)


def _trunk(network: str, name: str, size: int, sha256: str, word: str) -> WeightFile:
    purpose, command = f"{network} trunk of LPIPS", f"download weights {word}"
    return WeightFile(name, size, sha256, purpose, TORCHVISION + name, _TORCHVISION_LICENCE, command=command)


_ALEXNET_SHA256 = "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02"
_VGG16_SHA256 = "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0"
_SQUEEZENET_SHA256 = "b8a52dc049b60e4b6ab68ad0df457362afab8b6304b2febdc1650a5dab4d7e7b"
ALEXNET = _trunk("AlexNet", "alexnet-owt-7be5be79.pth", 244408911, _ALEXNET_SHA256, "lpips")
VGG16 = _trunk("VGG-16", "vgg16-397923af.pth", 553433881, _VGG16_SHA256, "lpips-vgg")
SQUEEZENET = _trunk("SqueezeNet 1.1", "squeezenet1_1-b8a52dc0.pth", 4958839, _SQUEEZENET_SHA256, "lpips-squeeze")
METAIQA = WeightFile(
    "metaiqa_resnet18.pth",
    None,  # several models of that name exist: the prior of TID2013 and KADID-10K, and fine-tuned ones
    None,
    "MetaIQA network as a state dict",
    "https://github.com/zhuhancheng/MetaIQA",
    "its repository states none: ask the authors",
)


class WeightsError(UserError):
    """A weight file that is absent or not the right one. `reason` says why, without paths of this machine."""

    def __init__(self, message: str, reason: str) -> None:
        super().__init__(message)
        self.reason = reason


def hub_folder() -> Path:
    """Return torch hub's folder of downloaded weights, by its rules; torch itself need not be imported for it."""
    caches = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache")
    return Path(os.environ.get("TORCH_HOME") or caches / "torch").expanduser() / "hub" / "checkpoints"


def find_weights(file: WeightFile | NamedWeights) -> FoundWeights:
    """Find a weight file, and check its hash where one is fixed.

    Raises WeightsError that names the file, where it was looked for, and how to get it.
    """
    paths = file.candidates
    for path in paths:
        if path.is_file():
            return _checked(FoundWeights(path), file)
    if len(paths) == 1:
        missing = problem(paths[0], file.description, "no such file", file.fix)
    elif isinstance(file, WeightFile):
        folders = " and ".join(str(path.parent) for path in paths)
        missing = problem(file.name, f"{file.description} in {folders}", "no such file", file.fix)
    else:
        missing = problem("weights", file.description, f"{file.variable} not set", file.fix)
    raise WeightsError(str(missing), file.need)


def read_header(path: Path, key: str, expected: str, fix: str) -> str:
    """Return the entry `key` of a safetensors file's metadata. torch is not imported.

    Raises UserError where the file is missing, damaged or another kind of file, and where it has no such entry.
    """
    import safetensors

    try:
        check_header(path)
        with safetensors.safe_open(path, framework="np") as f:
            meta: dict[str, str] = f.metadata() or {}
    except (safetensors.SafetensorError, OSError, ValueError) as e:
        raise unreadable(path, expected, e, fix) from None
    if key not in meta:
        raise problem(path, f"metadata {key}", ", ".join(meta) or "none", fix)
    return meta[key]


def read_tensors(path: Path, expected: str, fix: str) -> dict[str, Tensor]:
    """Return the tensors of a safetensors file by name, on the CPU.

    Raises UserError where the file is missing, damaged or another kind of file.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        check_header(path)
        return load_file(path)
    except (SafetensorError, OSError, *_DAMAGED) as e:
        raise unreadable(path, expected, e, fix) from None


def read_state(path: Path) -> dict[str, Tensor]:
    """Return the tensors of a state dict (.pth, .pt or .safetensors) by name, on the CPU.

    Only tensors are read: torch's restricted reader runs no code from the file. Raises UserError for anything else.
    """
    import torch

    expected, fix = "a file of tensors", "give a state dict (torch.save of model.state_dict(), or safetensors)"
    if path.suffix == ".safetensors":
        return read_tensors(path, expected, fix)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, EOFError, OSError, *_DAMAGED) as e:
        raise unreadable(path, expected, e, fix) from None
    if not isinstance(state, dict) or not all(isinstance(v, torch.Tensor) for v in state.values()):
        raise problem(path, "a mapping from names to tensors", type(state).__name__, fix)
    return state


def load_into(
    network: NetworkT,
    state: Mapping[str, Tensor],
    where: str | Path,
    what: str = "tensors of the network",
    fix: str = "give the file that belongs to this network",
) -> NetworkT:
    """Give `network`, which may be on torch's device `meta`, the parameters in `state` as float32; return it frozen.

    `where` and `what` are for the error. Raises UserError where names or shapes differ.
    """
    import torch

    own = network.state_dict()
    # Counters of batch normalisation are not used for inference, and old files lack them.
    wanted, found = (
        {name: tuple(t.shape) for name, t in tensors.items() if not name.endswith("num_batches_tracked")}
        for tensors in (own, state)
    )
    if wrong := sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name)):
        first = f"{wrong[0]} {found.get(wrong[0], 'missing')}"
        raise problem(where, f"the {len(wanted)} {what}", f"{len(wrong)} other tensors, the first {first}", fix)
    tensors = {name: state[name].to(torch.float32) for name in wanted}
    # A network on `meta` has no memory to copy to.
    network.load_state_dict(tensors, strict=False, assign=any(t.is_meta for t in own.values()))
    return network.requires_grad_(False).eval()


def unreadable(path: Path, expected: str, error: Exception, fix: str) -> UserError:
    """Return the error for a file that a reader of weights gave up on, for the caller to raise."""
    text = str(error).partition("\n")[0][:120]
    return problem(path, expected, f"damaged data or another kind of file ({type(error).__name__}: {text})", fix)


def _given(variable: str) -> Path | None:
    value = os.environ.get(variable)
    return Path(value).expanduser() if value else None


def _checked(found: FoundWeights, file: WeightFile | NamedWeights) -> FoundWeights:
    if isinstance(file, WeightFile) and file.sha256 not in (None, found.sha256):
        what = f"{found.path.stat().st_size} bytes with sha256 {found.sha256}"
        message = problem(found.path, file.description, what, f"replace it by the one from {file.source}")
        raise WeightsError(str(message), f"needs {file.description}; the file of that name here is another one")
    return found


@cache
def _sha256(path: Path, size: int, changed_ns: int) -> str:
    """The hash of a file as it was with that size and time of change: hashed again after it changes."""
    return sha256_file(path)
