"""Inputs of MSDI's networks, and streams of larger pixels."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from spike4dgs.method.msdi.inputs import Sensors, corrected, network_inputs, own_rates, shrink


@pytest.mark.parametrize(("factor", "size"), [(2, (6, 8)), (3, (7, 5)), (4, (5, 9))])
def test_shrunk_stream_is_that_of_larger_pixels(factor: int, size: tuple[int, int]) -> None:
    g = torch.Generator().manual_seed(0)
    x = (torch.rand(2, 1, 30, *size, generator=g) < torch.rand(2, 1, 1, *size, generator=g)).float()
    out = shrink(x, factor)
    rows, columns = (-(-n // factor) for n in size)
    assert out.shape == (2, 1, 30, rows, columns) and set(out.unique().tolist()) <= {0.0, 1.0}
    for sample, row, column in np.ndindex(2, rows, columns):
        block = x[sample, 0, :, factor * row : factor * (row + 1), factor * column : factor * (column + 1)]
        threshold = block[0].numel()
        charge = threshold / 2
        for tick in range(30):
            charge += float(block[tick].sum())
            fired = charge >= threshold
            charge -= threshold * fired
            assert out[sample, 0, tick, row, column] == fired
        assert abs(float(out[sample, 0, :, row, column].sum()) - 30 * float(block.mean())) <= 0.5 + 1e-5


def test_shrinking_keeps_dark_and_saturated_pixels() -> None:
    assert torch.equal(shrink(torch.zeros(1, 9, 5, 7), 2), torch.zeros(1, 9, 3, 4))
    assert torch.equal(shrink(torch.ones(1, 9, 5, 7), 2), torch.ones(1, 9, 3, 4))
    x = (torch.rand(2, 9, 5, 7, generator=torch.Generator().manual_seed(0)) < 0.4).float()
    assert torch.equal(shrink(x.bool(), 1), x)


def rates_plainly(spikes: np.ndarray, half_windows: tuple[int, ...]) -> list[float]:
    """Return `own_rates` of one pixel [T]."""
    middle, found = len(spikes) // 2, []
    for half in half_windows:
        times = [t for t in range(middle - half, middle + half) if spikes[t]]
        counted = len(times) / (2 * half)
        found += [(len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else counted, counted]
    before, after = ([t for t in times if spikes[t]] for times in (range(middle), range(middle, len(spikes))))
    found.append(1 / (after[0] - before[-1]) if before and after else sum(spikes) / len(spikes))
    return found


@given(st.lists(st.booleans(), min_size=9, max_size=9), st.sampled_from([(4,), (1, 2, 4), (2, 3)]))
def test_rates_are_those_of_a_plain_loop(spikes: list[bool], half_windows: tuple[int, ...]) -> None:
    found = own_rates(torch.tensor(spikes).float().view(1, 9, 1, 1), half_windows)
    np.testing.assert_allclose(found[0, :, 0, 0], rates_plainly(np.array(spikes), half_windows), rtol=1e-6)


def test_pixels_do_not_mix() -> None:
    x = (torch.rand(2, 9, 3, 4, generator=torch.Generator().manual_seed(0)) < 0.4).float()
    whole = own_rates(x, (2, 4))
    for n, v, u in np.ndindex(2, 3, 4):
        assert torch.equal(own_rates(x[n : n + 1, :, v : v + 1, u : u + 1], (2, 4))[0, :, 0, 0], whole[n, :, v, u])


def test_a_steady_rate_is_measured_by_its_intervals() -> None:
    spikes = torch.zeros(1, 41, 1, 1)
    spikes[:, ::3] = 1  # 14 of 41 ticks: a count over 40 says 0.325 or 0.35
    assert torch.allclose(own_rates(spikes, (7, 20))[0, [0, 2, 4], 0, 0], torch.tensor(1 / 3))


def test_corrected_rates_are_those_of_the_light() -> None:
    sensors = Sensors(torch.tensor([[1.25, 0.0]]), torch.tensor([[0.1, 0.2]]))
    light = torch.tensor([[0.4, 0.4]])
    seen = (light * sensors.sensitivity + sensors.dark).expand(1, 3, 1, 2)
    assert torch.allclose(corrected(seen, sensors), torch.tensor([[0.4, 0.0]]).expand(1, 3, 1, 2))


@pytest.mark.parametrize("fill", [0.0, 1.0])
def test_dark_and_saturated_pixels_have_finite_inputs(fill: float) -> None:
    maps = torch.full((1, 2, 2), 1.0), torch.full((1, 2, 2), 0.01)
    seen = network_inputs(torch.full((1, 9, 2, 2), fill), Sensors(*maps), (2, 4))
    assert seen.shape == (1, 14, 2, 2)
    assert torch.allclose(seen, torch.tensor(fill - 0.01))


def test_without_windows_the_spikes_are_all() -> None:
    x: Tensor = torch.eye(9).view(1, 9, 3, 3)
    assert network_inputs(x, None, ()) is x
