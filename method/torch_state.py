"""Torch's threads and random numbers in a fit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import nn

from spike4dgs.benchmark.environment import device_type
from spike4dgs.benchmark.errors import problem


def check_device(device: str) -> None:
    """Raise UserError unless torch can compute on `device`."""
    try:
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError):
        expected = "cpu, or a CUDA device of this machine"
        raise problem("--device", expected, repr(device), "use --device cpu") from None


def seeded(seed: int, step: int) -> torch.Generator:
    """Return the generator of one step's random numbers."""
    return torch.Generator().manual_seed((seed * 1_000_003 + step) % 2**63)


@torch.no_grad()
def follow(mean: nn.Module, live: nn.Module, step: int, average: float) -> None:
    """Move the running mean of a network's weights after `step` steps; the share `average` of it stays.

    The first steps are soon forgotten: of n, the mean is over about the last tenth until `average` is reached.
    """
    share = min(average, step / (step + 9))
    for own, parameter in zip(mean.parameters(), live.parameters(), strict=True):
        own.lerp_(parameter, 1 - share)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Run torch on one thread inside the context.

    Torch's own threads spin while they wait and take the cores from the rasteriser's, which do most of the work:
    500 ms a step with torch's two threads on 2 busy cores, 36 ms with one.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def kept_random_state(device: str) -> Iterator[None]:
    """Put the random states of torch and NumPy back at the end of the context."""
    before = np.random.get_state()
    try:
        with torch.random.fork_rng(devices=[device] if device_type(device) == "cuda" else []):
            yield
    finally:
        np.random.set_state(before)
