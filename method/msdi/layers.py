"""Layers of DUSt3R and Fast3R: pre-norm transformer blocks, and the head that gives a point and a confidence per pixel.

The head (Ranftl et al. 2021) takes tokens of four layers. Parameters are named as in the published weights of both.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

ROPE_BASE = 100.0
NORM_EPS = 1e-6


def rotate(x: Tensor, positions: Tensor) -> Tensor:
    """Return x [B, heads, N, D] rotated by its positions [N, 2] (row, column), in patches: RoPE in two dimensions.

    The first half of D turns with the row and the second with the column; within a half, number i is paired with
    number i + D / 4, and the pair turns by position / 100^(i / (D / 4)).
    """
    quarter = x.shape[-1] // 4
    frequency = ROPE_BASE ** (-torch.arange(quarter, device=x.device, dtype=torch.float32) / quarter)
    parts = []
    for half, position in zip(x.chunk(2, dim=-1), positions.T, strict=True):
        angle = position[:, None].float() * frequency  # [N, D / 4]
        cos, sin = angle.cos().to(x.dtype), angle.sin().to(x.dtype)
        a, b = half.chunk(2, dim=-1)
        parts += [a * cos - b * sin, b * cos + a * sin]
    return torch.cat(parts, dim=-1)


def attend(q: Tensor, k: Tensor, v: Tensor, heads: int) -> Tensor:
    """Return the attention [B, N, C] of queries [B, N, C] to keys and values [B, M, C], without positions."""
    out = functional.scaled_dot_product_attention(split(q, heads), split(k, heads), split(v, heads))
    return out.transpose(1, 2).flatten(2)


def attend_rotary(q: Tensor, k: Tensor, v: Tensor, q_positions: Tensor, k_positions: Tensor, heads: int) -> Tensor:
    """Return the attention [B, N, C] of [B, N, C] to [B, M, C], with queries and keys turned by their positions."""
    q, k = rotate(split(q, heads), q_positions), rotate(split(k, heads), k_positions)
    return functional.scaled_dot_product_attention(q, k, split(v, heads)).transpose(1, 2).flatten(2)


def split(x: Tensor, heads: int) -> Tensor:
    """Return [B, heads, N, C / heads] from [B, N, C]."""
    return x.unflatten(-1, (heads, -1)).transpose(1, 2)


class SelfAttention(nn.Module):
    """Attention of tokens to each other."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, x: Tensor, positions: Tensor | None = None) -> Tensor:
        """Return [B, N, C] from [B, N, C]; `positions` [N, 2] turn queries and keys."""
        q, k, v = self.qkv(x).chunk(3, dim=-1)
        heads = self.heads
        out: Tensor = (
            attend(q, k, v, heads) if positions is None else attend_rotary(q, k, v, positions, positions, heads)
        )
        out = self.proj(out)
        return out


class Mlp(nn.Module):
    """Two layers with GELU, four times as wide inside."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Return [..., C] from [..., C]."""
        out: Tensor = self.fc2(functional.gelu(self.fc1(x)))
        return out


class Block(nn.Module):
    """A pre-norm transformer layer."""

    def __init__(self, width: int, heads: int, eps: float = NORM_EPS) -> None:
        super().__init__()
        self.norm1, self.attn = nn.LayerNorm(width, eps=eps), SelfAttention(width, heads)
        self.norm2, self.mlp = nn.LayerNorm(width, eps=eps), Mlp(width)

    def forward(self, x: Tensor, positions: Tensor | None = None) -> Tensor:
        """Return [B, N, C] from [B, N, C]."""
        x = x + self.attn(self.norm1(x), positions)
        out: Tensor = x + self.mlp(self.norm2(x))
        return out


def initialize(blocks: nn.ModuleList) -> None:
    """Set Xavier weights; layers that add to the residual stream are smaller by the root of the number of additions."""
    for module in blocks.modules():
        if isinstance(module, nn.Linear):
            nn.init.xavier_uniform_(module.weight)
            nn.init.zeros_(module.bias)
    for block in blocks:
        for last in (block.attn.proj, block.mlp.fc2):  # type: ignore[union-attr]
            with torch.no_grad():
                last.weight.mul_((2 * len(blocks)) ** -0.5)  # type: ignore[union-attr, operator]


def grid(rows: int, columns: int, device: torch.device) -> Tensor:
    """Return the positions [rows * columns, 2] of patches (row, column), row by row."""
    return torch.cartesian_prod(torch.arange(rows, device=device), torch.arange(columns, device=device))


_LARGEST = 30.0  # argument of an exponential: e^30 is beyond all scenes, e^89 is beyond float32


class ResidualUnit(nn.Module):
    """Two 3x3 convolutions, added to the input."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1, self.conv2 = nn.Conv2d(width, width, 3, padding=1), nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Return [B, C, H, W] from [B, C, H, W]."""
        out: Tensor = x + self.conv2(functional.relu(self.conv1(functional.relu(x))))
        return out


class Fusion(nn.Module):
    """Add a finer level to the coarser ones, and double the size."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.resConfUnit1, self.resConfUnit2 = ResidualUnit(width), ResidualUnit(width)
        self.out_conv = nn.Conv2d(width, width, 1)

    def forward(self, x: Tensor, finer: Tensor | None = None) -> Tensor:
        """Return [B, C, 2 h, 2 w] from [B, C, h, w]."""
        x = self.resConfUnit2(x if finer is None else x + self.resConfUnit1(finer))
        out: Tensor = _double(self.out_conv(x))  # a 1x1 convolution and an interpolation commute: the cheap order
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
    """Tokens of four layers -> point and confidence of each pixel, before the output's exponentials.

    `tokens` are the widths of the four layers, `widths` those of the four levels; `patch` is 16 px, or 8, for which the
    last doubling is left out.
    """

    def __init__(self, tokens: Sequence[int], widths: Sequence[int], features: int, patch: int = 16) -> None:
        super().__init__()
        self.patch = patch
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
        self.head = nn.ModuleDict(  # named by position: 1 and 3 have no parameters
            {
                "0": nn.Conv2d(features, half, 3, padding=1),
                "2": nn.Conv2d(half, half, 3, padding=1),
                "4": nn.Conv2d(half, 4, 1),
            }
        )

    def forward(self, layers: list[Tensor], rows: int, columns: int) -> Tensor:
        """Return [B, 4, rows * patch, columns * patch] from `layers`, [B, rows * columns, C] of the four hooks."""
        maps = [x.transpose(1, 2).unflatten(2, (rows, columns)) for x in layers]
        levels = [post(x) for post, x in zip(self.act_postprocess, maps, strict=True)]
        levels = [conv(x) for conv, x in zip(self.scratch.layer_rn, levels, strict=True)]
        fuse = self.scratch
        x = fuse.refinenet4(levels[3])[:, :, :rows, :columns]  # odd counts of patches are rounded up
        x = fuse.refinenet1(fuse.refinenet2(fuse.refinenet3(x, levels[2]), levels[1]), levels[0])
        x = self.head["0"](x)
        out: Tensor = self.head["4"](functional.relu(self.head["2"](_double(x) if self.patch == 16 else x)))
        return out


def unpack(out: Tensor) -> tuple[Tensor, Tensor]:
    """Return points x / |x| * (exp|x| - 1) [B, H, W, 3] and confidence 1 + exp(c) [B, H, W] from (x, c) [B, 4, H, W].

    Exponents are at most 30, so that no training step gives infinity. Half floats become float32 first.
    """
    out = widened(out)
    x = out[:, :3].permute(0, 2, 3, 1)
    length = x.norm(dim=-1, keepdim=True)
    reach = torch.expm1(length.clamp(max=_LARGEST))
    return x / length.clamp(min=1e-8) * reach, 1 + out[:, 3].clamp(max=_LARGEST).exp()


def widened(x: Tensor) -> Tensor:
    """Return half floats as float32, others unchanged."""
    return x.float() if x.dtype in (torch.float16, torch.bfloat16) else x
