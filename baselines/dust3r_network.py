"""DUSt3R's network (Wang et al., CVPR 2024): two pictures to the points that they see, both in the first one's frame.

A ViT encodes each picture; two decoders attend to each other layer by layer; a DPT head (Ranftl et al. 2021) per
decoder gives a point and a confidence per pixel. Parameters are named as in the published weights of
`DUSt3R_ViTLarge_BaseDecoder_512_dpt`, so that a state dict loads by name. The weights are the authors', licensed
CC BY-NC-SA 4.0 (no commercial use); they are neither shipped nor downloaded. The code is ours.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from spike4dgs.benchmark.errors import problem

ROPE_BASE = 100.0
NORM_EPS = 1e-6


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
        """What the head sees: 0 is the encoder's output, k the k-th decoder layer's."""
        n = self.decoder_layers
        return 0, n // 2, 3 * n // 4, n


def rotate(x: Tensor, places: Tensor) -> Tensor:
    """RoPE in two dimensions: x [B, heads, N, D], places [N, 2] (row, column), both in patches.

    The first half of D turns with the row and the second with the column; within a half, number i is paired with
    number i + D / 4, and the pair turns by place / 100^(i / (D / 4)).
    """
    quarter = x.shape[-1] // 4
    frequency = ROPE_BASE ** (-torch.arange(quarter, device=x.device, dtype=torch.float32) / quarter)
    parts = []
    for half, place in zip(x.chunk(2, dim=-1), places.T, strict=True):
        angle = place[:, None].float() * frequency  # [N, D / 4]
        cos, sin = angle.cos().to(x.dtype), angle.sin().to(x.dtype)
        a, b = half.chunk(2, dim=-1)
        parts += [a * cos - b * sin, b * cos + a * sin]
    return torch.cat(parts, dim=-1)


def _attend(q: Tensor, k: Tensor, v: Tensor, q_places: Tensor, k_places: Tensor, heads: int) -> Tensor:
    """Attention of [B, N, C] to [B, M, C] with turned queries and keys."""

    def split(x: Tensor) -> Tensor:
        return x.unflatten(-1, (heads, -1)).transpose(1, 2)

    out = functional.scaled_dot_product_attention(rotate(split(q), q_places), rotate(split(k), k_places), split(v))
    return out.transpose(1, 2).flatten(2)


class SelfAttention(nn.Module):
    """Attention of tokens to each other."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, x: Tensor, places: Tensor) -> Tensor:
        """[B, N, C] -> [B, N, C]."""
        q, k, v = self.qkv(x).chunk(3, dim=-1)
        out: Tensor = self.proj(_attend(q, k, v, places, places, self.heads))
        return out


class CrossAttention(nn.Module):
    """Attention of one picture's tokens to the other's."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.projq, self.projk, self.projv = (nn.Linear(width, width) for _ in range(3))
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, other: Tensor, places: Tensor, other_places: Tensor) -> Tensor:
        """[B, N, C] and [B, M, C] -> [B, N, C]."""
        q, k, v = self.projq(x), self.projk(other), self.projv(other)
        out: Tensor = self.proj(_attend(q, k, v, places, other_places, self.heads))
        return out


class Mlp(nn.Module):
    """Two layers with GELU, four times as wide inside."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """[..., C] -> [..., C]."""
        out: Tensor = self.fc2(functional.gelu(self.fc1(x)))
        return out


def _norm(width: int) -> nn.LayerNorm:
    return nn.LayerNorm(width, eps=NORM_EPS)


class EncoderBlock(nn.Module):
    """A pre-norm transformer layer."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1, self.attn = _norm(width), SelfAttention(width, heads)
        self.norm2, self.mlp = _norm(width), Mlp(width)

    def forward(self, x: Tensor, places: Tensor) -> Tensor:
        """[B, N, C] -> [B, N, C]."""
        x = x + self.attn(self.norm1(x), places)
        out: Tensor = x + self.mlp(self.norm2(x))
        return out


class DecoderBlock(nn.Module):
    """A pre-norm layer with attention to the other picture between the two usual parts."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1, self.attn = _norm(width), SelfAttention(width, heads)
        self.norm2, self.norm_y, self.cross_attn = _norm(width), _norm(width), CrossAttention(width, heads)
        self.norm3, self.mlp = _norm(width), Mlp(width)

    def forward(self, x: Tensor, other: Tensor, places: Tensor, other_places: Tensor) -> Tensor:
        """[B, N, C] and [B, M, C] -> [B, N, C]."""
        x = x + self.attn(self.norm1(x), places)
        x = x + self.cross_attn(self.norm2(x), self.norm_y(other), places, other_places)
        out: Tensor = x + self.mlp(self.norm3(x))
        return out


class ResidualUnit(nn.Module):
    """Two 3x3 convolutions around which the input goes."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1, self.conv2 = nn.Conv2d(width, width, 3, padding=1), nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """[B, C, H, W] -> [B, C, H, W]."""
        out: Tensor = x + self.conv2(functional.relu(self.conv1(functional.relu(x))))
        return out


class Fusion(nn.Module):
    """Add a finer level to the coarser ones, and double the size."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.resConfUnit1, self.resConfUnit2 = ResidualUnit(width), ResidualUnit(width)
        self.out_conv = nn.Conv2d(width, width, 1)

    def forward(self, x: Tensor, finer: Tensor | None = None) -> Tensor:
        """[B, C, h, w] -> [B, C, 2 h, 2 w]."""
        x = self.resConfUnit2(x if finer is None else x + self.resConfUnit1(finer))
        out: Tensor = self.out_conv(_double(x))
        return out


def _double(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)


class Levels(nn.Module):
    """The head's layers by level, finest first, with the published names."""

    def __init__(self, widths: Sequence[int], features: int) -> None:
        super().__init__()
        self.layer_rn = nn.ModuleList(nn.Conv2d(w, features, 3, padding=1, bias=False) for w in widths)
        self.refinenet1, self.refinenet2, self.refinenet3, self.refinenet4 = (Fusion(features) for _ in widths)


class Dpt(nn.Module):
    """Tokens of four layers -> point and confidence of each pixel, [B, 4, H, W], before the output's exponentials."""

    def __init__(self, shape: Dust3rShape) -> None:
        super().__init__()
        widths, features = shape.head_widths, shape.head_features
        tokens = (shape.encoder_width, *[shape.decoder_width] * 3)
        scalers: tuple[list[nn.Module], ...] = (
            [nn.ConvTranspose2d(widths[0], widths[0], 4, stride=4)],
            [nn.ConvTranspose2d(widths[1], widths[1], 2, stride=2)],
            [],
            [nn.Conv2d(widths[3], widths[3], 3, stride=2, padding=1)],
        )
        self.act_postprocess = nn.ModuleList(
            nn.Sequential(nn.Conv2d(t, w, 1), *scaler) for t, w, scaler in zip(tokens, widths, scalers, strict=True)
        )
        self.scratch = Levels(widths, features)
        half = features // 2
        self.head = nn.ModuleDict(  # named by place: 1 and 3 have no parameters
            {
                "0": nn.Conv2d(features, half, 3, padding=1),
                "2": nn.Conv2d(half, half, 3, padding=1),
                "4": nn.Conv2d(half, 4, 1),
            }
        )

    def forward(self, layers: list[Tensor], rows: int, columns: int) -> Tensor:
        """`layers`: [B, rows * columns, C] of the four hooks."""
        maps = [x.transpose(1, 2).unflatten(2, (rows, columns)) for x in layers]
        levels = [post(x) for post, x in zip(self.act_postprocess, maps, strict=True)]
        levels = [conv(x) for conv, x in zip(self.scratch.layer_rn, levels, strict=True)]
        fuse = self.scratch
        x = fuse.refinenet4(levels[3])[:, :, :rows, :columns]  # odd counts of patches are rounded up
        x = fuse.refinenet1(fuse.refinenet2(fuse.refinenet3(x, levels[2]), levels[1]), levels[0])
        out: Tensor = self.head["4"](functional.relu(self.head["2"](_double(self.head["0"](x)))))
        return out


class Dust3r(nn.Module):
    """See the module. Pictures are [B, 3, H, W] in [-1, 1], their sides multiples of the patch."""

    def __init__(self, shape: Dust3rShape | None = None) -> None:
        super().__init__()
        self.shape = s = shape or Dust3rShape()
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, s.encoder_width, s.patch, stride=s.patch)})
        self.enc_blocks = nn.ModuleList(EncoderBlock(s.encoder_width, s.encoder_heads) for _ in range(s.encoder_layers))
        self.enc_norm = _norm(s.encoder_width)
        self.decoder_embed = nn.Linear(s.encoder_width, s.decoder_width)
        self.dec_blocks, self.dec_blocks2 = (
            nn.ModuleList(DecoderBlock(s.decoder_width, s.decoder_heads) for _ in range(s.decoder_layers))
            for _ in range(2)
        )
        self.dec_norm = _norm(s.decoder_width)
        self.downstream_head1, self.downstream_head2 = (nn.ModuleDict({"dpt": Dpt(s)}) for _ in range(2))

    def encode(self, pictures: Tensor) -> Tensor:
        """Tokens [B, N, C] of pictures, row by row."""
        x = self.patch_embed["proj"](pictures).flatten(2).transpose(1, 2)
        places = self._places(pictures)
        for block in self.enc_blocks:
            x = block(x, places)
        out: Tensor = self.enc_norm(x)
        return out

    def decode(self, first: Tensor, second: Tensor, pictures: Tensor) -> tuple[tuple[Tensor, Tensor], ...]:
        """(points [B, H, W, 3], confidence [B, H, W]) of both, in the first one's frame, from their tokens.

        `pictures` gives the size, which is the same for both.
        """
        places = self._places(pictures)
        pair = self.decoder_embed(first), self.decoder_embed(second)
        layers = [(first, second)]
        for one, two in zip(self.dec_blocks, self.dec_blocks2, strict=True):
            pair = one(pair[0], pair[1], places, places), two(pair[1], pair[0], places, places)
            layers.append(pair)
        layers[-1] = (self.dec_norm(pair[0]), self.dec_norm(pair[1]))
        rows, columns = (n // self.shape.patch for n in pictures.shape[-2:])
        heads = (self.downstream_head1["dpt"], self.downstream_head2["dpt"])
        return tuple(
            unpack(head([layers[h][view] for h in self.shape.hooks], rows, columns)) for view, head in enumerate(heads)
        )

    def _places(self, pictures: Tensor) -> Tensor:
        rows, columns = (torch.arange(n // self.shape.patch, device=pictures.device) for n in pictures.shape[-2:])
        return torch.cartesian_prod(rows, columns)


def unpack(out: Tensor) -> tuple[Tensor, Tensor]:
    """[B, 4, H, W] -> points x / |x| * (exp|x| - 1) [B, H, W, 3] and confidence 1 + exp(c) [B, H, W]."""
    x = out[:, :3].permute(0, 2, 3, 1)
    length = x.norm(dim=-1, keepdim=True)
    return x / length.clamp(min=1e-8) * torch.expm1(length), 1 + out[:, 3].exp()


# Stored in some of the published files and not needed: pre-training's mask token, and second names of the same layers.
_UNUSED = re.compile(r"mask_token|prediction_head\..*|(enc|dec)_pos_embed")


def canonical(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The state dict with the names that `Dust3r` uses: files keep one or the other of two names of a layer."""
    names = {}
    for name, tensor in state.items():
        if _UNUSED.fullmatch(name):
            continue
        name = re.sub(r"scratch\.layer([1-4])_rn\.", lambda m: f"scratch.layer_rn.{int(m[1]) - 1}.", name)
        name = re.sub(r"dpt\.act_([1-4])_postprocess\.", lambda m: f"dpt.act_postprocess.{int(m[1]) - 1}.", name)
        names[name] = tensor
    return names


def load_dust3r(path: Path, shape: Dust3rShape | None = None) -> Dust3r:
    """Build the network from a file of safetensors. Raises UserError where it is another network's or damaged."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    fix = "use model.safetensors of naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt"
    try:
        state = canonical(load_file(path))
    except (SafetensorError, OSError) as e:
        raise problem(path, "weights in safetensors format", str(e)[:120], fix) from None
    with torch.device("meta"):  # 571 M parameters need not be drawn at random first
        network = Dust3r(shape)
    wanted = {name: tuple(t.shape) for name, t in network.state_dict().items()}
    found = {name: tuple(t.shape) for name, t in state.items()}
    if wrong := sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name)):
        what = f"{len(wrong)} other tensors, the first {wrong[0]} {found.get(wrong[0], 'missing')}"
        raise problem(path, f"the {len(wanted)} tensors of DUSt3R with a ViT-L encoder and DPT heads", what, fix)
    network.load_state_dict({name: t.float() for name, t in state.items()}, assign=True)
    return network.eval().requires_grad_(False)
