"""Learning rates by step. Edits of the Gaussians' moments are tested with the Gaussians."""

import math

import pytest
import torch

from spike4dgs.method.gaussians.optimizer import WarmCosine, make_adam, set_learning_rate


def test_a_warm_cosine_rises_linearly_and_falls_to_nothing() -> None:
    schedule = WarmCosine(peak=3e-3, warm_up=8, steps=50)
    for step in range(50):
        rise = (step + 1) / 8 if step < 8 else 1.0
        assert schedule.at(step) == pytest.approx(3e-3 * rise * math.cos(math.pi * step / 100) ** 2, rel=1e-9)
    assert schedule.at(50) == pytest.approx(0, abs=1e-12)
    assert WarmCosine(peak=1.0, warm_up=1, steps=9).at(0) == 1


def test_one_rate_is_set_for_all_groups() -> None:
    adam = make_adam({name: [torch.zeros(1, requires_grad=True)] for name in ("a", "b")}, (0.9, 0.999))
    set_learning_rate(adam, 0.25)
    assert [group["lr"] for group in adam.param_groups] == [0.25, 0.25]
