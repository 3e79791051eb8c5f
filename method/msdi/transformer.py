"""Transformer layers as DUSt3R and Fast3R have them: pre-norm, with or without rotary places in two dimensions."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

ROPE_BASE = 100.0
NORM_EPS = 1e-6


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


def attend(q: Tensor, k: Tensor, v: Tensor, heads: int) -> Tensor:
    """Attention of queries [B, N, C] to keys and values [B, M, C] without places: [B, N, C]."""
    out = functional.scaled_dot_product_attention(split(q, heads), split(k, heads), split(v, heads))
    return out.transpose(1, 2).flatten(2)


def attend_placed(q: Tensor, k: Tensor, v: Tensor, q_places: Tensor, k_places: Tensor, heads: int) -> Tensor:
    """Attention of [B, N, C] to [B, M, C] with queries and keys turned by their places: [B, N, C]."""
    q, k = rotate(split(q, heads), q_places), rotate(split(k, heads), k_places)
    return functional.scaled_dot_product_attention(q, k, split(v, heads)).transpose(1, 2).flatten(2)


def split(x: Tensor, heads: int) -> Tensor:
    """[B, N, C] -> [B, heads, N, C / heads]."""
    return x.unflatten(-1, (heads, -1)).transpose(1, 2)


class SelfAttention(nn.Module):
    """Attention of tokens to each other."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, x: Tensor, places: Tensor | None = None) -> Tensor:
        """[B, N, C] -> [B, N, C]; `places` [N, 2] turn queries and keys."""
        q, k, v = self.qkv(x).chunk(3, dim=-1)
        heads = self.heads
        out: Tensor = attend(q, k, v, heads) if places is None else attend_placed(q, k, v, places, places, heads)
        out = self.proj(out)
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


class Block(nn.Module):
    """A pre-norm transformer layer."""

    def __init__(self, width: int, heads: int, eps: float = NORM_EPS) -> None:
        super().__init__()
        self.norm1, self.attn = nn.LayerNorm(width, eps=eps), SelfAttention(width, heads)
        self.norm2, self.mlp = nn.LayerNorm(width, eps=eps), Mlp(width)

    def forward(self, x: Tensor, places: Tensor | None = None) -> Tensor:
        """[B, N, C] -> [B, N, C]."""
        x = x + self.attn(self.norm1(x), places)
        out: Tensor = x + self.mlp(self.norm2(x))
        return out


def initialize(blocks: nn.ModuleList) -> None:
    """Xavier weights; what is added to the residual stream starts smaller, by the root of the number of additions."""
    for module in blocks.modules():
        if isinstance(module, nn.Linear):
            nn.init.xavier_uniform_(module.weight)
            nn.init.zeros_(module.bias)
    for block in blocks:
        for last in (block.attn.proj, block.mlp.fc2):  # type: ignore[union-attr]
            with torch.no_grad():
                last.weight.mul_((2 * len(blocks)) ** -0.5)  # type: ignore[union-attr, operator]


def grid(rows: int, columns: int, device: torch.device) -> Tensor:
    """Places [rows * columns, 2] of patches (row, column), row by row."""
    return torch.cartesian_prod(torch.arange(rows, device=device), torch.arange(columns, device=device))
