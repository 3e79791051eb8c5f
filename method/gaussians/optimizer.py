"""Adam over named groups: schedules, edits of the number of Gaussians, and its state as plain tensors."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.optim.adam import adam as torch_adam

from spike4dgs.benchmark.errors import problem
from spike4dgs.method.gaussians.parameters import Edit, Gaussians

MOMENTS = ("exp_avg", "exp_avg_sq")


@dataclass(frozen=True)
class Decay:
    """A learning rate that falls log-linearly from `first` to `last` over a stage."""

    first: float
    last: float

    def __post_init__(self) -> None:
        if not min(self.first, self.last) > 0:
            raise problem("settings", "learning rates above 0", f"{self.first:g} to {self.last:g}", "correct them")

    def at(self, fraction: float) -> float:
        """Return the learning rate after `fraction` in [0, 1] of the stage."""
        return math.exp((1 - fraction) * math.log(self.first) + fraction * math.log(self.last))


@dataclass(frozen=True)
class WarmCosine:
    """A learning rate that rises linearly to `peak` in `warm_up` steps, and falls to nothing with the cosine."""

    peak: float
    warm_up: int  # steps
    steps: int  # of the whole training

    def at(self, step: int) -> float:
        """Return the learning rate of a step."""
        rise = min(1.0, (step + 1) / self.warm_up)
        return self.peak * rise * 0.5 * (1 + math.cos(math.pi * step / self.steps))


@dataclass(eq=False)
class Group:
    """Parameters with one learning rate."""

    name: str
    params: list[Tensor]
    lr: float = 0.0


class Adam:
    """Adam (Kingma and Ba 2015) over named groups, whose learning rates are set before each step.

    The update is torch's own. `torch.optim.Adam` also imports torch's compiler, a second of one core in every process
    that fits. eps is 1e-15 as in 3DGS: gradients of single Gaussians are far below the usual 1e-8.
    """

    def __init__(self, groups: dict[str, list[Tensor]], betas: tuple[float, float]) -> None:
        self.groups = [Group(name, params) for name, params in groups.items() if params]
        self.betas = betas
        self.state: dict[Tensor, dict[str, Tensor]] = {}  # of the parameters that have had a gradient

    def zero_grad(self) -> None:
        """Forget all gradients."""
        for group in self.groups:
            for p in group.params:
                p.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Move every parameter that has a gradient."""
        for group in self.groups:
            live = [(p, p.grad) for p in group.params if p.grad is not None]
            if not live:
                continue
            states = [self._state(p) for p, _ in live]
            step, mean, square = ([state[key] for state in states] for key in ("step", *MOMENTS))
            torch_adam(
                [p for p, _ in live],
                [g for _, g in live],
                mean,
                square,
                [],
                step,
                fused=True,
                amsgrad=False,
                beta1=self.betas[0],
                beta2=self.betas[1],
                lr=group.lr,
                weight_decay=0.0,
                eps=1e-15,
                maximize=False,
            )

    def step_clipped(self) -> None:
        """Move as `step` does, by gradients whose norm in each group is 1 at most.

        Where a norm is not finite nothing moves: one bad sample must not ruin a network.
        """
        norms = [torch.nn.utils.clip_grad_norm_(group.params, 1.0) for group in self.groups]
        if all(norm.isfinite() for norm in norms):
            self.step()

    def _state(self, p: Tensor) -> dict[str, Tensor]:
        if p not in self.state:
            zeros = {moment: torch.zeros_like(p) for moment in MOMENTS}
            self.state[p] = {"step": torch.zeros((), device=p.device), **zeros}
        return self.state[p]


def set_learning_rates(adam: Adam, rates: dict[str, Decay], fraction: float) -> None:
    """Set every group's learning rate for the point `fraction` in [0, 1] of a stage."""
    for group in adam.groups:
        group.lr = rates[group.name].at(fraction)


def set_learning_rate(adam: Adam, rate: float) -> None:
    """Set one learning rate for all groups."""
    for group in adam.groups:
        group.lr = rate


def apply_edit(adam: Adam, edit: Edit) -> Gaussians:
    """Replace the Gaussians' parameters in `adam` by those of an edit, moments included; return the new leaves."""
    new = edit.gaussians.trainable()
    kept = edit.source >= 0
    for group in adam.groups:
        leaf = new.tensors().get(group.name)
        if leaf is None:
            continue
        state = adam.state.pop(group.params[0], {})
        for moment in MOMENTS:
            if moment in state:
                old, fresh = state[moment], torch.zeros_like(leaf)
                fresh[kept] = old[edit.source[kept]]
                state[moment] = fresh
        group.params = [leaf]
        if state:
            adam.state[leaf] = state
    return new


class Averages:
    """Running means of all of an optimiser's parameters (Polyak and Ruppert's averaging), as `GROUP.INDEX` -> tensor.

    Steps of a few views each leave the parameters jittering around the optimum at the size of the learning rate; their
    mean does not.
    """

    def __init__(self) -> None:
        self.means: dict[str, Tensor] = {}

    def add(self, adam: Adam, count: int) -> None:
        """Take in the parameters of the `count`-th step that is averaged, from 1 on."""
        for name, p in _parameters(adam):
            value = p.detach()
            self.means[name] = value.clone() if count == 1 else self.means[name].lerp_(value, 1 / count)

    def apply(self, adam: Adam) -> None:
        """Replace the parameters by their means."""
        with torch.no_grad():
            for name, p in _parameters(adam):
                p.copy_(self.means[name])


def _parameters(adam: Adam) -> Iterator[tuple[str, Tensor]]:
    for group in adam.groups:
        for i, p in enumerate(group.params):
            yield f"{group.name}.{i}", p


def export_state(adam: Adam) -> dict[str, Tensor]:
    """Return moments and step counts as `GROUP.INDEX.KEY` -> tensor."""
    return {f"{name}.{key}": value for name, p in _parameters(adam) for key, value in adam.state.get(p, {}).items()}


def import_state(adam: Adam, tensors: dict[str, Tensor]) -> None:
    """Restore what `export_state` gave, for the same groups and shapes."""
    for name, p in _parameters(adam):
        prefix = f"{name}."
        state = {k.removeprefix(prefix): v.to(p.device) for k, v in tensors.items() if k.startswith(prefix)}
        if state:
            adam.state[p] = state
