"""Weight files that users bring: where they are looked for, and proof that they are the right ones.

Nothing is downloaded. A file is taken from the folder (or is the file) that the environment variable SPIKE4DGS_WEIGHTS
names, or from the folder in which torch hub keeps what it has downloaded. torch hub does not hash files that it has
already; here every file is hashed, once per process.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import sha256_file

VARIABLE = "SPIKE4DGS_WEIGHTS"
TORCHVISION = "https://download.pytorch.org/models/"


@dataclass(frozen=True)
class WeightFile:
    """A file that a metric needs. Without `sha256` any file of that name is taken, and its hash is recorded."""

    name: str
    bytes: int | None
    sha256: str | None
    purpose: str
    source: str  # where users find it

    @property
    def description(self) -> str:
        """Name, size, hash and purpose in one phrase."""
        size = f"{self.bytes} bytes" if self.bytes else "any size"
        return f"{self.name} ({self.purpose}; {size}, sha256 {self.sha256 or 'not fixed'})"


@dataclass(frozen=True)
class FoundWeights:
    """A weight file on this machine, hashed."""

    path: Path
    sha256: str


ALEXNET = WeightFile(
    "alexnet-owt-7be5be79.pth",
    244408911,
    "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02",
    "AlexNet trunk of LPIPS",
    f"{TORCHVISION}alexnet-owt-7be5be79.pth",
)
VGG16 = WeightFile(
    "vgg16-397923af.pth",
    553433881,
    "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
    "VGG-16 trunk of LPIPS",
    f"{TORCHVISION}vgg16-397923af.pth",
)
SQUEEZENET = WeightFile(
    "squeezenet1_1-b8a52dc0.pth",
    4958839,
    "b8a52dc049b60e4b6ab68ad0df457362afab8b6304b2febdc1650a5dab4d7e7b",
    "SqueezeNet 1.1 trunk of LPIPS",
    f"{TORCHVISION}squeezenet1_1-b8a52dc0.pth",
)
METAIQA = WeightFile(
    "metaiqa_resnet18.pth",
    None,  # several models of that name exist: the prior of TID2013 and KADID-10K, and fine-tuned ones
    None,
    "MetaIQA network as a state dict",
    "https://github.com/zhuhancheng/MetaIQA",
)


class WeightsError(UserError):
    """A weight file that is absent or not the right one. `reason` says why, without paths of this machine."""

    def __init__(self, message: str, reason: str) -> None:
        super().__init__(message)
        self.reason = reason


def hub_folder() -> Path:
    """torch hub's folder of downloaded weights, by its rules; torch itself need not be imported for it."""
    caches = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache")
    return Path(os.environ.get("TORCH_HOME") or caches / "torch").expanduser() / "hub" / "checkpoints"


def find_weights(file: WeightFile) -> FoundWeights:
    """Find and hash a weight file.

    Raises WeightsError that names the file, its size and sha256, the folders that were searched, and where to put it.
    """
    given = Path(os.environ[VARIABLE]).expanduser() if os.environ.get(VARIABLE) else None
    folders = [hub_folder()]
    if given is not None:
        folders.insert(0, given.parent if given.is_file() else given)
    candidates = [folder / file.name for folder in folders]
    for path in candidates:
        if path.is_file():
            return FoundWeights(path, _checked(path, file))
    searched = " and ".join(map(str, folders))
    fix = f"get it from {file.source} and put it there, or set {VARIABLE} to the folder that holds it"
    message = problem(file.name, f"{file.description} in {searched}", "no such file", fix)
    raise WeightsError(str(message), f"needs the file {file.description}, which is not on this machine")


def _checked(path: Path, file: WeightFile) -> str:
    status = path.stat()
    found = _sha256(path, status.st_size, status.st_mtime_ns)
    if file.sha256 not in (None, found):
        what = f"{status.st_size} bytes with sha256 {found}"
        message = problem(path, file.description, what, f"replace it by the one from {file.source}")
        raise WeightsError(str(message), f"needs {file.description}; the file of that name here is another one")
    return found


@cache
def _sha256(path: Path, size: int, changed_ns: int) -> str:
    """The hash of a file as it was with that size and time of change: hashed again after it changes."""
    return sha256_file(path)
