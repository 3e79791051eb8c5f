"""Learning rates by step. Edits of the Gaussians' moments are tested with the Gaussians."""

import math

import pytest
import torch

from spike4dgs.method.gaussians.optimizer import Averages, WarmCosine, make_adam, set_learning_rate


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


@pytest.mark.parametrize("count", [1, 2, 7])
def test_averages_are_plain_means_of_all_parameters(count: int) -> None:
    a, b = torch.zeros(5, 3, requires_grad=True), torch.zeros(2, requires_grad=True)
    adam, averages, seen = make_adam({"a": [a], "b": [b]}, (0.9, 0.99)), Averages(), []
    for n in range(1, count + 1):
        with torch.no_grad():
            a.copy_(torch.randn(a.shape, generator=torch.Generator().manual_seed(n)))
            b.copy_(torch.randn(b.shape, generator=torch.Generator().manual_seed(100 + n)))
        seen.append((a.detach().double(), b.detach().double()))
        averages.add(adam, n)
    averages.apply(adam)
    for leaf, values in zip((a, b), zip(*seen, strict=True), strict=True):
        torch.testing.assert_close(leaf.detach().double(), torch.stack(values).mean(0), atol=1e-6, rtol=0)
