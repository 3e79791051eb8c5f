"""The spiking layer against plain loops, its surrogate gradient where it is smooth, and the bias of its resets."""

import numpy as np
import pytest
import torch
from hard_case import HardCase

from spike4dgs.method.supervision.spike import FLOOR, encode, firing_rate, spike_loss


@pytest.mark.hard_case(
    asked="{which} of currents 0 to 1e6 from all starts, 1 to 256 steps, {reset} reset",
    twin="a loop over the steps, float64", unit="spikes per step, or of the slope", tolerance=1e-12,
)  # fmt: skip
@pytest.mark.parametrize("which", ["firing rates", "surrogate gradients"])
@pytest.mark.parametrize("reset", ["subtract", "hard"])
def test_neurons_are_those_of_a_loop(hard_case: HardCase, reset: str, which: str) -> None:
    """All numbers are multiples of 2^-12: every sum is exact, and thresholds are met exactly now and then."""
    levels = torch.tensor([0, 1, 16, 82, 1024, 1229, 2048, 4095, 4096, 6144, 4096e6], dtype=torch.float64) / 4096
    current, start = torch.meshgrid(levels, levels[levels < 1], indexing="ij")
    for steps in (1, 2, 7, 70, 256):
        charge, count, last = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
        for step in range(1, steps + 1):
            charge = charge + current.clamp(max=1)
            fired = charge >= 1
            count, last = count + fired, last.where(~fired, step)
            charge = charge - fired.double() if reset == "subtract" else charge.where(~fired, 0.0)
        leaf = current.clone().requires_grad_()
        rate = firing_rate(leaf, start, steps, reset)
        rate.sum().backward()
        found, expected = (rate.detach(), count) if which == "firing rates" else (leaf.grad, last)
        hard_case.close(found.numpy(), (expected / steps).numpy(), f"{steps} steps")


def test_mean_over_starts_is_the_current_and_the_surrogate_its_finite_difference() -> None:
    """Over uniform starts the subtractive rate is I exactly: smooth, with slope 1. The surrogate leaves out the steps
    after the last spike, on average half an interval: 1 - 1 / (2 I M), and never less than 1 - 1 / (I M)."""
    steps, n = 128, 4096
    starts = (torch.arange(n).double() + 0.5) / n

    def mean(i: float) -> float:
        return float(firing_rate(torch.full((n,), i, dtype=torch.float64), starts, steps).mean())

    for i in (0.05, 0.13, 0.37, 0.6, 0.92):
        assert mean(i) == pytest.approx(i, abs=1 / n)
        difference = (mean(i + 0.02) - mean(i - 0.02)) / 0.04
        assert difference == pytest.approx(1, abs=2 / (n * 0.04))
        current = torch.full((n,), i, dtype=torch.float64, requires_grad=True)
        firing_rate(current, starts, steps).mean().backward()
        surrogate = float(current.grad.sum())
        assert 1 - 1 / (i * steps) <= surrogate <= 1
        assert surrogate == pytest.approx(1 - 0.5 / (i * steps) + 0.5 / steps, abs=2e-3)


def test_a_hard_reset_is_biased_and_a_subtraction_is_not() -> None:
    current = torch.linspace(0.02, 0.5, 20001, dtype=torch.float64)
    zero = torch.zeros_like(current)
    hard, soft = (firing_rate(current, zero, 4096, reset) for reset in ("hard", "subtract"))
    error = ((hard - current).abs() / current).numpy()
    print(f"hard reset: mean error {100 * error.mean():.1f} %, largest {100 * error.max():.1f} %")
    assert 0.10 < error.mean() < 0.14
    intervals = np.ceil(1 / current.numpy() - 1e-12)  # rates 1/n only
    np.testing.assert_allclose(hard.numpy(), 1 / intervals, rtol=5e-3, atol=1 / 4096)
    assert float((soft - current).abs().max()) <= 1 / 4096
    just_below_one = firing_rate(torch.tensor([0.999]), torch.zeros(1), 4096, "hard")
    assert float(just_below_one) == 0.5  # half of the spikes are lost


def test_the_loss_is_the_published_one_and_finite_at_zero() -> None:
    rate = torch.tensor([0.0, 0.2, 0.6], requires_grad=True)
    recorded = torch.tensor([0.1, 0.2, 0.0])
    loss = spike_loss(rate, recorded)
    expected = np.mean(
        [((r + FLOOR) ** (1 / 2.2) - (t + FLOOR) ** (1 / 2.2)) ** 2 for r, t in [(0, 0.1), (0.6, 0)]] * 1
    )
    assert float(loss.detach()) == pytest.approx(expected * 2 / 3, rel=1e-5)
    loss.backward()
    assert rate.grad.isfinite().all() and rate.grad[0] < 0 < rate.grad[2]
    assert float(encode(torch.tensor(1.0))) == pytest.approx(1, abs=2e-3)
