"""Modules of a file: made without memory first, so that a file's numbers allocate no more than its tensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

import torch
from torch import Tensor, nn

WITHOUT_MEMORY = torch.device("meta")
ModuleT = TypeVar("ModuleT", bound=nn.Module)


def make_filled(make: Callable[[], ModuleT], tensors: Mapping[str, Tensor]) -> ModuleT:
    """Return the module that `make` makes, with these tensors. Raises ValueError where they are not all of its own."""
    with WITHOUT_MEMORY:
        wanted = {name: tuple(t.shape) for name, t in make().state_dict().items()}
    found = {name: tuple(t.shape) for name, t in tensors.items()}
    if wrong := sorted(n for n in wanted.keys() | found.keys() if wanted.get(n) != found.get(n)):
        raise ValueError(
            f"{wrong[0]} {found.get(wrong[0], 'missing')} in place of {wanted.get(wrong[0], 'none')}"[:200]
        )
    made = make()
    made.load_state_dict(dict(tensors))
    return made
