"""The Gaussians of a scene: raw parameters, activations, and edits that change their number.

An edit says for each new row which old row its optimiser state continues (`source`, -1 starts afresh), so that every
way of adding and removing Gaussians keeps Adam's moments consistent by one rule (`optimizer.apply_edit`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from spike4dgs.benchmark.errors import problem
from spike4dgs.method.splat import Splats
from spike4dgs.method.splat.reference import rotation_matrices

SPLIT_SHRINK = 1.6  # a split Gaussian's two halves are this much smaller (3DGS)
MAX_COPIES = 51  # the relocation formula's alternating sum is evaluated up to this many copies (MCMC)
_SIDES: dict[str, tuple[int, ...]] = {"means": (3,), "log_scales": (3,), "quats": (4,), "logits": ()}  # after the first
_COMMON = (*_SIDES, "colors")


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians as raw parameters, which an optimiser may push anywhere: activations make them valid.

    `extra` holds what a motion model keeps of every Gaussian, under names of its own; edits treat it as the rest.
    """

    means: Tensor  # [N, 3] m
    log_scales: Tensor  # [N, 3] natural logarithm of the standard deviations in m
    quats: Tensor  # [N, 4] wxyz, any length but 0
    logits: Tensor  # [N] opacity before the sigmoid
    colors: Tensor  # [N, 1] gray linear radiance, 1.0 = white, no activation
    extra: dict[str, Tensor] = field(default_factory=dict)  # name -> [N, ...]

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> Gaussians:
        """Return the Gaussians whose `tensors` these are."""
        extra = {k: v for k, v in tensors.items() if k not in _COMMON}
        return cls(**{k: tensors[k] for k in _COMMON}, extra=extra)

    @classmethod
    def from_file(cls, tensors: Mapping[str, Tensor]) -> Gaussians:
        """Return the Gaussians of a file's `tensors`. Raises KeyError or ValueError where they are none."""
        n = len(tensors["means"])
        for name, tensor in tensors.items():
            sides = _SIDES.get(name, tuple(tensor.shape[1:]))
            if tuple(tensor.shape) != (n, *sides) or tensor.dtype != torch.float32:
                raise ValueError(f"{name} of {n} Gaussians is {tensor.dtype} {tuple(tensor.shape)}")
        return cls.from_tensors(tensors)

    def __len__(self) -> int:
        return self.means.shape[0]

    def tensors(self) -> dict[str, Tensor]:
        """Return the parameters by name."""
        return {name: getattr(self, name) for name in _COMMON} | self.extra

    def rows(self, index: Tensor) -> Gaussians:
        """Return the Gaussians of `index` (integers or a mask), detached."""
        return Gaussians.from_tensors({k: v.detach()[index] for k, v in self.tensors().items()})

    def detached(self) -> Gaussians:
        """Return copies that no gradient reaches and no optimiser changes."""
        return Gaussians.from_tensors({k: v.detach().clone() for k, v in self.tensors().items()})

    def trainable(self) -> Gaussians:
        """Return detached copies that require gradients."""
        leaves = {k: v.detach().clone().contiguous().requires_grad_(True) for k, v in self.tensors().items()}
        return Gaussians.from_tensors(leaves)

    def splats(self) -> Splats:
        """Return activated values for the renderer."""
        return Splats(self.means, self.quats, self.log_scales.exp(), self.logits.sigmoid(), self.colors)


@dataclass(frozen=True, eq=False)
class Edit:
    """The Gaussians after a change; `source` [M] is the old row whose optimiser moments a new row keeps, or -1."""

    gaussians: Gaussians
    source: Tensor
    added: int = 0  # how many of the last rows are new


def concatenate(parts: list[Gaussians]) -> Gaussians:
    """Return Gaussians one after another; all have the same extra parameters."""
    tensors = [p.tensors() for p in parts]
    return Gaussians.from_tensors({name: torch.cat([t[name] for t in tensors]) for name in tensors[0]})


def from_points(
    points: NDArray[np.float32], values: NDArray[np.float32], *, opacity: float, scale: float = 1.0, device: str = "cpu"
) -> Gaussians:
    """Return round Gaussians at points [N, 3] with gray values [N]; width: `scale` x mean distance of the 3 nearest.

    Raises UserError for fewer than 4 points or values that are not finite.
    """
    finite = np.isfinite(points).all(axis=1)
    if len(points) < 4 or not finite.all():
        found = f"{int(finite.sum())} of {len(points)}"
        raise problem("initialization", "at least 4 points, all finite", found, "check the poses and the streams")
    if not np.isfinite(values).all():
        found = f"{int((~np.isfinite(values)).sum())} others"
        raise problem("initialization", "finite gray values of the points", found, "check the images")
    distance = cKDTree(points).query(points, k=4)[0][:, 1:].mean(axis=1)  # [N]
    distance = np.maximum(distance, 1e-6 * float(np.ptp(points, axis=0).max()) + 1e-9)  # coincident points
    n = len(points)

    def tensor(a: NDArray[np.floating]) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(a), dtype=torch.float32, device=device)

    return Gaussians(
        means=tensor(points),
        log_scales=tensor(np.repeat(np.log(scale * distance)[:, None], 3, axis=1)),
        quats=tensor(np.tile(np.array([1.0, 0.0, 0.0, 0.0]), (n, 1))),
        logits=tensor(np.full(n, math.log(opacity / (1 - opacity)))),
        colors=tensor(values[:, None]),
    )


def appended(gaussians: Gaussians, before: int) -> Edit:
    """Return the edit that made Gaussians of the `before` first ones, which are unchanged."""
    index = torch.arange(len(gaussians), device=gaussians.means.device)
    return Edit(gaussians, torch.where(index < before, index, -1))


def prune(gaussians: Gaussians, keep: Tensor) -> Edit:
    """Keep the Gaussians of the mask `keep` [N]."""
    index = torch.nonzero(keep)[:, 0]
    return Edit(gaussians.rows(index), index)


def densify(gaussians: Gaussians, clone: Tensor, split: Tensor, generator: torch.Generator) -> Edit:
    """Duplicate the Gaussians of the mask `clone` [N]; replace those of `split` [N] by two samples of them.

    Clones start at the same position and are driven apart by the optimiser; the halves of a split are samples of the
    Gaussian with scales divided by 1.6 (3DGS). Old rows keep their order and moments, new rows follow.
    """
    keep, cloned, halved = (torch.nonzero(m)[:, 0] for m in (~split, clone & ~split, split))
    twice = gaussians.rows(halved.repeat(2))
    scales = twice.log_scales.exp()
    noise = torch.randn(scales.shape, generator=generator).to(scales)
    offset = torch.einsum("nij,nj->ni", rotation_matrices(twice.quats), noise * scales)
    halves = replace(twice, means=twice.means + offset, log_scales=twice.log_scales - math.log(SPLIT_SHRINK))
    added = len(cloned) + len(halves)
    source = torch.cat([keep, keep.new_full((added,), -1)])
    return Edit(concatenate([gaussians.rows(keep), gaussians.rows(cloned), halves]), source, added)


def relocate(gaussians: Gaussians, dead: Tensor, generator: torch.Generator) -> Edit:
    """Move the Gaussians of the mask `dead` [N] onto living ones, sampled in proportion to their opacity.

    A living Gaussian that receives copies shares its opacity and scale with them such that the sum renders as it did
    before (`share`). Its moments and theirs start afresh. The number of Gaussians does not change.
    """
    gone, living = torch.nonzero(dead)[:, 0], torch.nonzero(~dead)[:, 0]
    source = torch.arange(len(gaussians), device=dead.device)
    values = gaussians.rows(source)
    if not len(gone) or not len(living):
        return Edit(values, source)
    weights = values.logits[living].sigmoid().cpu()
    chosen = living[torch.multinomial(weights, len(gone), replacement=True, generator=generator).to(living.device)]
    copies = torch.bincount(chosen, minlength=len(gaussians)) + 1  # [N] Gaussians that now share each position
    opacity, shrink = share(values.logits[chosen].sigmoid(), copies[chosen])
    moved = values.rows(chosen)
    logits, log_scales = torch.logit(opacity), moved.log_scales + shrink.log()[:, None]
    for index in (gone, chosen):
        values.logits[index], values.log_scales[index] = logits, log_scales
    for name, value in values.tensors().items():
        if name not in ("logits", "log_scales"):
            value[gone] = moved.tensors()[name]
    source[gone], source[chosen] = -1, -1
    return Edit(values, source)


def share(opacity: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Return opacity [K] and scale factor [K] of `copies` [K] coincident Gaussians that replace one of `opacity` [K].

    With n copies (Kheradmand et al. 2024, eq. 9): o' = 1 - (1 - o)^(1/n) keeps the opacity at the centre, and
    s'/s = o / sum_{i=1..n} sum_{k=0..i-1} binom(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1) keeps the integral along a line.
    """
    n = copies.clamp(1, MAX_COPIES).double()  # of integers, torch's 1 / n is float32
    o = opacity.double().clamp(1e-6, 1 - 1e-6)
    new = 1 - (1 - o) ** (1 / n)
    # Swapping the sums leaves one: sum over i of binom(i-1, k) for i <= n is binom(n, k+1).
    k = torch.arange(MAX_COPIES, dtype=torch.float64, device=o.device)
    binomial = _log_binomial(n[:, None], k + 1)
    terms = torch.where(k < n[:, None], torch.exp(binomial + (k + 1) * new.log()[:, None]), 0.0)  # [K, MAX_COPIES]
    total = (terms * (-1) ** k / (k + 1).sqrt()).sum(-1)
    return new.to(opacity.dtype), (o / total).to(opacity.dtype)


def _log_binomial(n: Tensor, k: Tensor) -> Tensor:
    return torch.lgamma(n + 1) - torch.lgamma(k + 1) - torch.lgamma((n - k).clamp(min=0) + 1)


def nearest(points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Return (indices int64 [N, k], distances float64 [N, k], m) of the `k` < N points nearest each of `points` [N, 3].

    The nearest comes first. No point is its own neighbour; points that coincide are neighbours of each other.
    """
    at = points.detach().cpu().double().numpy()
    distance, index = (torch.as_tensor(found) for found in cKDTree(at).query(at, k=k + 1))
    # A point is not always its own first neighbour: coincident points come in any order.
    itself = index == torch.arange(len(at))[:, None]  # [N, k + 1]
    itself[:, -1] |= ~itself.any(dim=1)
    others = ~itself
    return index[others].view(-1, k).to(points.device), distance[others].view(-1, k).to(points.device)
