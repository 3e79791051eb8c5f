"""DUSt3R's network (Wang et al., CVPR 2024): two images to the points that they see, both in the first one's frame.

A ViT encodes each image; two decoders attend to each other layer by layer; a DPT head (Ranftl et al. 2021) per
decoder gives a point and a confidence per pixel. Parameters are named as in the published weights of
`DUSt3R_ViTLarge_BaseDecoder_512_dpt`, so that a state dict loads by name. The weights are the authors', licensed
CC BY-NC-SA 4.0 (no commercial use); they are neither shipped nor downloaded. The code is ours; layers and head are
shared with MSDI.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from spike4dgs.benchmark.weights import load_into, read_tensors
from spike4dgs.method.msdi.checkpoints import canonical_head
from spike4dgs.method.msdi.layers import NORM_EPS, Block, Dpt, Mlp, SelfAttention, attend_rotary, grid, unpack


@dataclass(frozen=True)
class Dust3rShape:
    """Sizes of the network; the defaults are those of the published weights (ViT-L encoder, ViT-B decoders)."""

    encoder_layers: int = 24
    encoder_width: int = 1024
    encoder_heads: int = 16
    decoder_layers: int = 12
    decoder_width: int = 768
    decoder_heads: int = 12
    patch: int = 16
    head_widths: tuple[int, int, int, int] = (96, 192, 384, 768)
    head_features: int = 256

    @property
    def hooks(self) -> tuple[int, int, int, int]:
        """The layers that the head reads: 0 is the encoder's output, k the k-th decoder layer's."""
        n = self.decoder_layers
        return 0, n // 2, 3 * n // 4, n


class CrossAttention(nn.Module):
    """Attention of one image's tokens to the other's."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.projq, self.projk, self.projv = (nn.Linear(width, width) for _ in range(3))
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, other: Tensor, positions: Tensor, other_positions: Tensor) -> Tensor:
        """[B, N, C] and [B, M, C] -> [B, N, C]."""
        q, k, v = self.projq(x), self.projk(other), self.projv(other)
        out: Tensor = self.proj(attend_rotary(q, k, v, positions, other_positions, self.heads))
        return out


def _norm(width: int) -> nn.LayerNorm:
    return nn.LayerNorm(width, eps=NORM_EPS)


class DecoderBlock(nn.Module):
    """A pre-norm layer with attention to the other image between the two usual parts."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1, self.attn = _norm(width), SelfAttention(width, heads)
        self.norm2, self.norm_y, self.cross_attn = _norm(width), _norm(width), CrossAttention(width, heads)
        self.norm3, self.mlp = _norm(width), Mlp(width)

    def forward(self, x: Tensor, other: Tensor, positions: Tensor, other_positions: Tensor) -> Tensor:
        """[B, N, C] and [B, M, C] -> [B, N, C]."""
        x = x + self.attn(self.norm1(x), positions)
        x = x + self.cross_attn(self.norm2(x), self.norm_y(other), positions, other_positions)
        out: Tensor = x + self.mlp(self.norm3(x))
        return out


def _dpt(shape: Dust3rShape) -> Dpt:
    tokens = (shape.encoder_width, *[shape.decoder_width] * 3)
    return Dpt(tokens, shape.head_widths, shape.head_features, shape.patch)


class Dust3r(nn.Module):
    """See the module. Images are [B, 3, H, W] in [-1, 1], their sides multiples of the patch."""

    def __init__(self, shape: Dust3rShape | None = None) -> None:
        super().__init__()
        self.shape = s = shape or Dust3rShape()
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, s.encoder_width, s.patch, stride=s.patch)})
        self.enc_blocks = nn.ModuleList(Block(s.encoder_width, s.encoder_heads) for _ in range(s.encoder_layers))
        self.enc_norm = _norm(s.encoder_width)
        self.decoder_embed = nn.Linear(s.encoder_width, s.decoder_width)
        self.dec_blocks, self.dec_blocks2 = (
            nn.ModuleList(DecoderBlock(s.decoder_width, s.decoder_heads) for _ in range(s.decoder_layers))
            for _ in range(2)
        )
        self.dec_norm = _norm(s.decoder_width)
        self.downstream_head1, self.downstream_head2 = (nn.ModuleDict({"dpt": _dpt(s)}) for _ in range(2))

    def encode(self, images: Tensor) -> Tensor:
        """Return tokens [B, N, C] of images, row by row."""
        x = self.patch_embed["proj"](images).flatten(2).transpose(1, 2)
        positions = self._positions(images)
        for block in self.enc_blocks:
            x = block(x, positions)
        out: Tensor = self.enc_norm(x)
        return out

    def decode(self, first: Tensor, second: Tensor, images: Tensor) -> tuple[tuple[Tensor, Tensor], ...]:
        """(points [B, H, W, 3], confidence [B, H, W]) of both, in the first one's frame, from their tokens.

        `images` gives the size, which is the same for both.
        """
        positions = self._positions(images)
        pair = self.decoder_embed(first), self.decoder_embed(second)
        layers = [(first, second)]
        for one, two in zip(self.dec_blocks, self.dec_blocks2, strict=True):
            pair = one(pair[0], pair[1], positions, positions), two(pair[1], pair[0], positions, positions)
            layers.append(pair)
        layers[-1] = (self.dec_norm(pair[0]), self.dec_norm(pair[1]))
        rows, columns = (n // self.shape.patch for n in images.shape[-2:])
        heads = (self.downstream_head1["dpt"], self.downstream_head2["dpt"])
        return tuple(
            unpack(head([layers[h][view] for h in self.shape.hooks], rows, columns)) for view, head in enumerate(heads)
        )

    def _positions(self, images: Tensor) -> Tensor:
        rows, columns = (n // self.shape.patch for n in images.shape[-2:])
        return grid(rows, columns, images.device)


# Stored in some of the published files and not needed: pre-training's mask token, and second names of the same layers.
_UNUSED = re.compile(r"mask_token|prediction_head\..*|(enc|dec)_pos_embed")


def canonical(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the state dict with the names that `Dust3r` uses: files keep one or the other of two names of a layer."""
    return {canonical_head(name): tensor for name, tensor in state.items() if not _UNUSED.fullmatch(name)}


def load_dust3r(path: Path, shape: Dust3rShape | None = None) -> Dust3r:
    """Build the network from a file of safetensors. Raises UserError where it is another network's or damaged."""
    fix = "use model.safetensors of naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt"
    state = canonical(read_tensors(path, "weights in safetensors format", fix))
    with torch.device("meta"):  # 571 M parameters need no random start
        network = Dust3r(shape)
    return load_into(network, state, path, "tensors of DUSt3R with a ViT-L encoder and DPT heads", fix)
