"""Transformer layers of DUSt3R and Fast3R: pre-norm, with or without rotary positions in two dimensions."""

from __future__ import annotations

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
