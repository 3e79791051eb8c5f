"""Weights that users bring, for the configuration `paper`: Fast3R's or DUSt3R's published files.

| file | parts taken |
|---|---|
| Fast3R, `model.safetensors` of jedyang97/Fast3R_ViT_Large_512 | encoder, fusion transformer and the global head |
| DUSt3R, `model.safetensors` of naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt | encoder |

DUSt3R's decoders work on pairs of views and are 768 wide, and so are the inputs of its heads; this network has neither
(Fast3R too starts from DUSt3R's encoder alone). Fast3R's second head, for points in each view's own frame, is left out.
Extractor, image generator, the mixing layer before the patch embedding and the embedding of rays are in no file: they
keep their values and must be trained. The weights are their authors' and come under their licences; they are neither
shipped nor downloaded. Only safetensors files are read: nothing is unpickled.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from spike4dgs.benchmark.errors import problem
from spike4dgs.method.msdi.network import Msdi

_FIX = "use model.safetensors of jedyang97/Fast3R_ViT_Large_512 or naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt"


# Published name -> ours; the first pattern that matches counts. The head's names agree from `dpt.` on.
_ENCODER = (
    (r"patch_embed\.proj\.(.*)", r"encoder.patch_embed.\1"),
    (r"enc_blocks\.(.*)", r"encoder.blocks.\1"),
    (r"enc_norm\.(.*)", r"encoder.norm.\1"),
)
_FAST3R = (
    *((rf"encoder\.{pattern}", ours) for pattern, ours in _ENCODER),
    (r"decoder\.decoder_embed\.(.*)", r"fusion.embed.\1"),
    (r"decoder\.dec_blocks\.(.*)", r"fusion.blocks.\1"),
    (r"decoder\.dec_norm\.(.*)", r"fusion.norm.\1"),
    (r"downstream_head\.dpt\.(.*)", r"head.\1"),
)
_RULES = {"fast3r": _FAST3R, "dust3r": _ENCODER}
_PARTS = {"fast3r": ("encoder.", "fusion.", "head."), "dust3r": ("encoder.",)}
_OURS = ("encoder.mix.", "encoder.ray_embed.")  # tensors of those parts that only this network has

# Some files keep the other of two names that a layer of the head has.
_HEAD_NAMES = (
    (re.compile(r"scratch\.layer([1-4])_rn\."), "scratch.layer_rn.{}."),
    (re.compile(r"dpt\.act_([1-4])_postprocess\."), "dpt.act_postprocess.{}."),
)


def canonical_head(name: str) -> str:
    """Return the name that `layers.Dpt` uses for a head's layer, from either of its published names."""
    for pattern, ours in _HEAD_NAMES:
        name = pattern.sub(lambda m, ours=ours: ours.format(int(m[1]) - 1), name)  # type: ignore[misc]
    return name


def source_of(names: Mapping[str, Tensor]) -> str | None:
    """Return the origin of a state dict: "fast3r", "dust3r" or None."""
    if any(name.startswith("decoder.dec_blocks.") for name in names):
        return "fast3r"
    if any(name.startswith("dec_blocks2.") for name in names):
        return "dust3r"
    return None


def renamed(state: Mapping[str, Tensor], source: str) -> dict[str, Tensor]:
    """Return tensors under this network's names, without those that it does not have."""
    ours: dict[str, Tensor] = {}
    for name, tensor in state.items():
        for pattern, replacement in _RULES[source]:
            if match := re.fullmatch(pattern, canonical_head(name)):
                ours[match.expand(replacement)] = tensor
                break
    return ours


def transfer(network: Msdi, state: Mapping[str, Tensor], path: Path) -> None:
    """Take a state dict of Fast3R or DUSt3R for `network`, in place; tensors that it has not keep their values.

    `path` is for the error. Raises UserError where the tensors are neither's, or of other sizes than the network's.
    """
    source = source_of(state)
    if source is None:
        raise problem(path, "the tensors of Fast3R or DUSt3R", f"others, such as {min(state, default='none')}", _FIX)
    found = renamed(state, source)
    own = network.state_dict()
    wanted = {n for n in own if n.startswith(_PARTS[source]) and not n.startswith(_OURS)}
    shapes = {n: tuple(t.shape) for n, t in found.items()}
    if wrong := sorted(n for n in wanted | shapes.keys() if n not in own or shapes.get(n) != tuple(own[n].shape)):
        first = wrong[0]
        what = f"{len(wrong)} other tensors, the first {first} {shapes.get(first, 'missing')}"
        expected = f"the {len(wanted)} tensors of {source} that configuration {network.config.name} takes"
        raise problem(path, expected, what, _FIX)
    with torch.no_grad():
        for name, tensor in found.items():
            own[name].copy_(tensor)
