"""MetaIQA (Zhu et al., CVPR 2020): a no-reference quality score in 0..1 by a ResNet-18, with the user's weights.

The image is resized to 224x224 pixels (bilinear, whatever its proportions), repeated to three channels and normalised
as for ImageNet; the class scores go through three linear layers. Published models differ (the prior learnt on TID2013
and KADID-10K, and models fine-tuned on LIVE-C), so a score means nothing without the hash of its weights: the record
has it. The prior was released as a whole pickled model, which is never read here: save its state dict.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.weights import METAIQA, find_weights, load_into, read_state

if TYPE_CHECKING:
    from torch import nn

SIDE = 224  # pixels
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet


def metaiqa_network() -> nn.Module:
    """Return the network with random weights, named as in the published state dicts: `resnet_layer.*` and `net.*`."""
    from collections import OrderedDict

    from torch import nn

    from spike4dgs.benchmark.metrics.neural_trunks import ResNet18

    head = OrderedDict(
        fc1=nn.Linear(1000, 1024),
        bn1=nn.BatchNorm1d(1024),
        relu1=nn.PReLU(),
        fc2=nn.Linear(1024, 512),
        bn2=nn.BatchNorm1d(512),
        relu2=nn.PReLU(),
        fc3=nn.Linear(512, 1),
        sig=nn.Sigmoid(),
    )
    return nn.Sequential(OrderedDict(resnet_layer=ResNet18(), net=nn.Sequential(head)))


@cache
def _load(path: Path, sha256: str) -> nn.Module:
    """Return the network with the weights of a file; read again when the file's hash changes."""
    return load_into(metaiqa_network(), read_state(path), path)


def predict(network: nn.Module, image: UInt8) -> float:
    """Score of an 8-bit gray image [H, W]; higher is better. Raises UserError for other arrays and for flat images."""
    import torch
    from skimage.transform import resize

    if image.dtype != np.uint8 or image.ndim != 2:
        raise problem("MetaIQA", "an 8-bit gray image", f"{image.dtype} {image.shape}", "encode it as sRGB first")
    if image.min() == image.max():
        raise problem("MetaIQA", "an image of something", "one value everywhere", "render the scene")
    small = np.clip(resize(image / 255, (SIDE, SIDE), anti_aliasing=True), 0, 1)  # type: ignore[no-untyped-call]
    channels = np.stack([(small - mean) / std for mean, std in zip(_MEAN, _STD, strict=True)])  # [3, 224, 224]
    with torch.inference_mode():
        return float(network(torch.from_numpy(channels[None].astype(np.float32))))


def metaiqa(image: UInt8) -> float:
    """Return the MetaIQA score of an sRGB-encoded 8-bit gray image [H, W], in 0..1; higher is better.

    Raises UserError for other or flat images, WeightsError where the file of weights is absent.
    """
    found = find_weights(METAIQA)
    return predict(_load(found.path, found.sha256), image)
