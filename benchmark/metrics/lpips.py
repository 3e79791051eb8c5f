"""LPIPS 0.1: the learned perceptual distance of Zhang et al. (2018), with AlexNet, VGG-16 or SqueezeNet.

    d = sum over layers of mean over pixels of sum over channels of  w_c (f_c(a) / |f(a)| - f_c(b) / |f(b)|)^2

f are features of an image network whose weights the user brings (weights.py); the heads w ship with this package.
Published figures differ in the network, so the metric's name has it. Gray images are repeated to three channels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import as_file
from importlib.resources import files as package_files
from pathlib import Path
from typing import TYPE_CHECKING

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.weights import ALEXNET, SQUEEZENET, VGG16, WeightFile, find_weights, load_into, read_state

if TYPE_CHECKING:  # torch takes seconds to import and is needed only where there are weights
    from torch import Tensor, nn

TRUNKS: dict[str, WeightFile] = {"alex": ALEXNET, "vgg": VGG16, "squeeze": SQUEEZENET}
SMALLEST = 32  # pixels; below it AlexNet's second pooling has nothing left
_SHIFT = (-0.030, -0.088, -0.188)  # what the heads were trained with, for images in [-1, 1]
_SCALE = (0.458, 0.448, 0.450)
_TAPS = {  # layers of the trunk whose outputs are compared
    "alex": (1, 4, 7, 9, 11),
    "vgg": (3, 8, 15, 22, 29),
    "squeeze": (1, 4, 7, 9, 10, 11, 12),
}


@dataclass(frozen=True, eq=False)
class LpipsNetwork:
    """A trunk with its heads. `weights` has one vector [C] for each tapped layer."""

    trunk: nn.Sequential
    taps: tuple[int, ...]
    weights: tuple[Tensor, ...]

    def distance(self, a: UInt8, b: UInt8) -> float:
        """Return LPIPS of two 8-bit gray images [H, W]. Raises UserError unless they are such images of one size."""
        import torch

        for image in (a, b):
            if image.dtype != "uint8" or image.ndim != 2 or image.shape != b.shape or min(image.shape) < SMALLEST:
                expected = f"two 8-bit gray images of one size, at least {SMALLEST}x{SMALLEST}"
                raise problem("LPIPS", expected, f"{a.dtype} {a.shape}, {b.dtype} {b.shape}", "use larger images")
        levels = torch.stack([torch.from_numpy(a), torch.from_numpy(b)])[:, None].to(torch.float32)  # [2, 1, H, W]
        shift, scale = (torch.tensor(v).view(1, 3, 1, 1) for v in (_SHIFT, _SCALE))
        x = (levels / 127.5 - 1 - shift) / scale  # [2, 3, H, W]
        total = torch.zeros(())
        heads = dict(zip(self.taps, self.weights, strict=True))
        with torch.inference_mode():
            for index, layer in enumerate(self.trunk):
                x = layer(x)
                if index in heads:
                    unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
                    difference = (unit[0] - unit[1]).square()  # [C, H', W']
                    total = total + (heads[index][:, None, None] * difference).sum(0).mean()
        return float(total)


def make_network(net: str, features: nn.Sequential) -> LpipsNetwork:
    """Put the heads of `net` ("alex", "vgg", "squeeze") on its trunk."""
    from safetensors.torch import load_file

    with as_file(package_files("spike4dgs.benchmark.metrics") / "lpips_heads.safetensors") as path:
        heads = load_file(path)
    taps = _TAPS[net]
    return LpipsNetwork(features, taps, tuple(heads[f"{net}.{i}"] for i in range(len(taps))))


def empty_trunk(net: str) -> nn.Sequential:
    """Return the trunk of `net` with random weights."""
    from spike4dgs.benchmark.metrics import neural_trunks

    makers = {
        "alex": neural_trunks.alexnet_features,
        "vgg": neural_trunks.vgg16_features,
        "squeeze": neural_trunks.squeezenet_features,
    }
    return makers[net]()


@cache
def _load(net: str, path: Path, sha256: str) -> LpipsNetwork:
    """Return the network with the weights of a file; read again when the file's hash changes."""
    trunk, prefix = empty_trunk(net), "features."
    # The classifier behind the features is in the file too, and not used.
    state = {k.removeprefix(prefix): v for k, v in read_state(path).items() if k.startswith(prefix)}
    load_into(trunk, state, path)
    return make_network(net, trunk)


def lpips(net: str, a: UInt8, b: UInt8) -> float:
    """Return LPIPS of two sRGB-encoded 8-bit gray images [H, W]; 0 for equal ones.

    Raises UserError for other images, WeightsError where the trunk's file is absent or another one.
    """
    found = find_weights(TRUNKS[net])
    return _load(net, found.path, found.sha256).distance(a, b)
