"""The published packages `lpips` and torchvision with random weights, run in a process of their own."""

import importlib.util
import subprocess
import sys
import tempfile
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cpu_torchvision import import_torchvision
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]


@cache
def published_networks() -> Arrays:
    """Return two images `a`, `b` and an input `x`, and each network's state dict and output.

    `alex/features.0.weight`, ..., `alex/head.0`, ..., `alex/value`; `resnet/conv1.weight`, ..., `resnet/value`. The
    test is skipped if a package is absent: `pip install --no-deps lpips torchvision` installs both.
    """
    for package in ("lpips", "torchvision"):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed (pip install --no-deps lpips torchvision, of torch's release)")
    rng = np.random.default_rng(0)
    given = {name: rng.integers(0, 256, (48, 64), dtype=np.uint8) for name in "ab"}
    given["x"] = rng.standard_normal((2, 3, 64, 96)).astype(np.float32)
    with tempfile.TemporaryDirectory() as folder:
        paths = [str(Path(folder) / name) for name in ("given.npz", "found.npz")]
        np.savez(paths[0], **given)
        subprocess.run([sys.executable, __file__, *paths], check=True)
        with np.load(paths[1]) as found:
            return given | dict(found)


class _Unused(torch.nn.Linear):
    """A layer without numbers: LPIPS throws away the classifiers, which have most of the networks' parameters."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs, device="meta")


def _lpips(net: str, a: NDArray[np.uint8], b: NDArray[np.uint8]) -> Arrays:
    import lpips

    metric = lpips.LPIPS(net=net, pnet_rand=True, verbose=False)  # random trunk, published heads
    state = {
        k: v for i in range(metric.net.N_slices) for k, v in getattr(metric.net, f"slice{i + 1}").state_dict().items()
    }
    out = {f"{net}/features.{k}": v.numpy() for k, v in state.items()}
    out |= {f"{net}/head.{i}": layer.model[1].weight.numpy().ravel() for i, layer in enumerate(metric.lins)}
    images = [torch.from_numpy(image / 127.5 - 1).float().expand(1, 3, *image.shape) for image in (a, b)]
    return out | {f"{net}/value": metric(*images).numpy().ravel()}


def _resnet(x: NDArray[np.float32]) -> Arrays:
    import torchvision

    network = torchvision.models.resnet18(weights=None)
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):  # statistics that are not those of an untrained network
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.5, 1.5)
    out = {f"resnet/{k}": v.numpy() for k, v in network.state_dict().items()}
    return out | {"resnet/value": network.eval()(torch.from_numpy(x)).numpy()}


def _main(given_path: str, found_path: str) -> None:
    warnings.simplefilter("ignore")  # deprecations within the packages
    import_torchvision()
    torch.manual_seed(7)
    given = np.load(given_path)
    with torch.no_grad():
        found = _resnet(given["x"])
        torch.nn.Linear = _Unused  # type: ignore[misc]
        for net in ("alex", "vgg", "squeeze"):
            found |= _lpips(net, given["a"], given["b"])
    np.savez(found_path, **found)


if __name__ == "__main__":
    _main(*sys.argv[1:])
