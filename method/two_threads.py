"""Two threads for the steps of a fit that torch's own threads would slow down; see `torch_state.one_torch_thread`."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

import torch

P = TypeVar("P")
R = TypeVar("R")


@cache
def _helper() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, "second", initializer=lambda: torch.set_num_threads(1))


def on_two_threads(work: Callable[[P], R], mine: P, other: P) -> tuple[R, R]:
    """Return work(mine), from this thread, and work(other), from a second one. Work must not call this in turn."""
    later = _helper().submit(work, other)
    return work(mine), later.result()
