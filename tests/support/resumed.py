"""Trainings that stop and go on, and tensors that have to be the same to the bit."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from spike4dgs.benchmark.errors import UserError


def same_tensors(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    """Assert the same names, and the same numbers under each."""
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert torch.equal(found[name], value), name


def check_resumed(make: Callable[[], Any], path: Path) -> None:
    """Check that a training that is resumed after three steps has the bits of one that never stopped."""
    whole, first, second = (make() for _ in range(3))
    losses = [whole.train_step() for _ in range(6)]
    torch.rand(3)  # other random numbers do not matter
    for _ in range(3):
        first.train_step()
    first.save(path, "key")
    second.resume(path, "key")
    assert second.step == 3 and [second.train_step() for _ in range(3)] == losses[3:]
    same_tensors(second.network.state_dict(), whole.network.state_dict())
    with pytest.raises(UserError, match="another fit's"):
        second.resume(path, "another key")
