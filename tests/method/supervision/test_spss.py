"""SPSS and the losses it is compared with, against neurons run tick by tick and phi_s applied to every pixel."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from toy_world import GAIN, RATE_HZ, ToyWorld, run_neurons

from spike4dgs.benchmark.scene.calibration import Recordings
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.splat.ssim import ssim
from spike4dgs.method.supervision import spss
from spike4dgs.method.supervision.base import Sample, Supervision
from spike4dgs.method.supervision.pixel import Pixel, PixelSettings
from spike4dgs.method.supervision.spike_cameras import SpikeCameras, fire, random_charge, recorded
from spike4dgs.method.supervision.table import SUPERVISIONS

WORLD = ToyWorld(width=32, height=20, side=2, n_ticks=120)
SETTINGS = spss.SpikeVariationSettings()
VIEWS = (0, 2)


def sample(tick: int, step: int = 0, images: torch.Tensor | None = None) -> Sample:
    return Sample(tick / 120, tick, VIEWS, torch.zeros(2, 20, 32) if images is None else images, step)


def make(name: str, scene: TrainingScene = WORLD.training, **changes: float) -> Supervision:
    return SUPERVISIONS[name](replace(SUPERVISIONS[name].defaults, **changes), scene)


def truth(t: float) -> torch.Tensor:
    cameras = WORLD.training.cameras
    return torch.from_numpy(np.stack([WORLD.trace(cameras[v], t)[0] for v in VIEWS])).float()


def every_pixel(phi: torch.nn.Linear, spike: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Eq. 16 as written: phi_s on (H, W, 1) gives (H, W, Gamma), of which average and deviation are taken."""
    sequence = phi(spike[..., None]).sigmoid()
    average = sequence.mean(-1)
    return average, ((sequence - average[..., None]).square().mean(-1) + spss.FLOOR).sqrt()


def other_phi(ticks: int, seed: int) -> torch.nn.Linear:
    """A phi_s that has been trained somehow."""
    phi = torch.nn.Linear(1, ticks).double()
    g = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        phi.weight.copy_(4 * torch.randn(ticks, 1, generator=g))
        phi.bias.copy_(torch.randn(ticks, generator=g))
    return phi


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([1, 2, 7, 40]), st.sampled_from([1, 3, 40]))
def test_the_table_gives_the_values_and_gradients_of_phi_on_every_pixel(seed: int, ticks: int, levels: int) -> None:
    phi, g = other_phi(ticks, seed), torch.Generator().manual_seed(seed + 1)
    counts = torch.randint(0, levels + 1, (2, 5, 6), generator=g).double()
    weights = torch.randn(2, 2, 5, 6, generator=g).double()
    results = []
    for f in (lambda s: spss.window_moments(phi, s, levels), lambda s: every_pixel(phi, s)):
        spike = (counts / levels).requires_grad_()
        average, deviation = f(spike)
        loss = (weights[0] * average + weights[1] * deviation).sum()
        results.append([average, deviation, *torch.autograd.grad(loss, [spike, *phi.parameters()])])
    for fast, slow in zip(*results, strict=True):
        torch.testing.assert_close(fast, slow, rtol=1e-9, atol=1e-12)


def test_surrogate_gradient_is_that_of_the_mean_over_all_charges() -> None:
    """Over all charges the average of the window is a smooth function of the rate: a staircase with Gamma steps, of
    which the mean slope over one step is compared."""
    phi, levels, n = torch.nn.Linear(1, 40).double(), 256, 8000
    spss.first_sequence(phi)
    charge = torch.rand(n, generator=torch.Generator().manual_seed(0)).double()
    spread = (torch.arange(n).double() + 0.5) / n - 0.5

    def average(rate: torch.Tensor) -> torch.Tensor:
        return spss.window_moments(phi, fire(rate, charge, levels) / levels, levels)[0].mean()

    for value in (0.08, 0.31, 0.55, 0.93):
        rate = (value + spread / 40).requires_grad_()
        (found,) = torch.autograd.grad(average(rate), rate)
        with torch.no_grad():
            numeric = float((average(rate + 0.025) - average(rate - 0.025)) / 0.05)
        assert numeric == pytest.approx(1, abs=0.02)
        assert float(found.sum()) == pytest.approx(numeric, rel=0.05)


@pytest.mark.parametrize("ticks", [8, 40, 200])
def test_phi_begins_as_the_sequence_of_an_even_stream(ticks: int) -> None:
    phi = torch.nn.Linear(1, ticks).double()
    spss.first_sequence(phi)
    s = torch.arange(257).double() / 256
    with torch.no_grad():
        average, deviation = spss.window_moments(phi, s, 256)
        assert float((average - s).abs().max()) < 0.5 / ticks
        middle = slice(32, -32)
        torch.testing.assert_close(deviation[middle], (s * (1 - s)).sqrt()[middle], rtol=0, atol=1.2 / ticks)


@pytest.mark.parametrize("tick", [0, 60, 119])
def test_the_whole_loss_is_equations_14_to_18(tick: int) -> None:
    scene, step = WORLD.training, 5
    target, rendered = truth(0.4).double(), truth(0.6).double()
    loss = make("spss", ssim_weight=0.0).double()
    found = float(loss(lambda t: rendered, sample(tick, step, target)).detach())
    charge = random_charge(rendered, step).numpy()
    spike = run_neurons(GAIN * rendered.numpy(), charge, SETTINGS.neuron_ticks) / SETTINGS.neuron_ticks
    (variation,) = (m for m in loss.modules() if isinstance(m, spss.SpikeVariation))
    average, deviation = (m.detach().numpy() for m in every_pixel(variation.phi, torch.from_numpy(spike)))
    window = slice(max(0, tick - 20), min(120, tick + 20))
    seen = np.stack([scene.streams[v].window(window.start, window.stop) for v in VIEWS]).astype(np.float64)
    expected = np.abs(rendered.numpy() - target.numpy()).mean()
    expected += np.abs(average - seen.mean(1)).mean()
    expected += np.abs(deviation - np.sqrt(seen.var(1) + spss.FLOOR)).mean()
    assert found == pytest.approx(expected, rel=1e-6)


def test_the_spike_loss_is_spikenerfs() -> None:
    rendered, step = truth(0.6).double(), 3
    found = float(make("spike").double()(lambda t: rendered, sample(60, step)))
    charge = random_charge(rendered, step).numpy()
    rate = run_neurons(GAIN * rendered.numpy(), charge, SETTINGS.neuron_ticks) / SETTINGS.neuron_ticks
    seen = np.stack([WORLD.training.streams[v].window(40, 80) for v in VIEWS]).mean(1)
    errors = (rate + 1 / 256) ** (1 / 2.2) - (seen + 1 / 256) ** (1 / 2.2)
    assert found == pytest.approx(float(np.mean(errors**2)), rel=1e-6)


def test_sums_render_once_and_add_up() -> None:
    target, calls = truth(0.4), []

    def render(t: float) -> torch.Tensor:
        calls.append(t)
        return truth(0.6)

    def value(loss: Supervision) -> float:
        return float(loss(render, sample(60, 1, target)).detach())

    pixel, spike = value(make("pixel")), value(make("spike"))
    variation = value(spss.SpikeVariation(SETTINGS, WORLD.training))
    calls.clear()
    assert value(make("pixel+spike")) == pytest.approx(pixel + spike, rel=1e-6)
    assert value(make("spss")) == pytest.approx(pixel + variation, rel=1e-6)
    assert calls == [0.5, 0.5]
    expected = 0.8 * (truth(0.6) - target).abs().mean() + 0.2 * (1 - ssim(truth(0.6), target))
    assert pixel == pytest.approx(float(expected), rel=1e-6)


def test_phi_is_trained_and_kept_and_maps_are_not() -> None:
    loss = make("spss")
    ((parameters, rate),) = loss.groups().values()
    assert {p.numel() for p in parameters} == {40} and rate.at(0.3) == pytest.approx(SETTINGS.lr_phi)
    assert {name.rsplit(".", 1)[-1] for name in loss.state_dict()} == {"weight", "bias"}
    loss(lambda t: truth(t), sample(60, 0, truth(0.5))).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in parameters)
    assert not make("pixel+spike").groups() and not make("spike").state_dict()


@pytest.mark.parametrize("name", ["spike", "pixel+spike", "spss"])
def test_the_right_image_is_better_than_others(name: str) -> None:
    loss = make(name)

    def mean(change: float) -> float:
        shown = truth(0.5)
        return float(np.mean([loss(lambda t: shown + change, sample(60, k, shown)).detach() for k in range(4)]))

    assert mean(0.0) < 0.8 * min(mean(0.06), mean(-0.06))


def gray_scene(radiance: float, gain: np.ndarray, dark: float, recordings: bool) -> TrainingScene:
    """Three cameras of pixel gains [20, 32] before uniform light."""

    def record(light: float, ticks: int, seed: int) -> SpikeStream:
        charge = np.random.default_rng(seed).random(gain.shape)
        steps = GAIN * gain * light + dark
        total = np.floor(charge + steps * np.arange(ticks + 1)[:, None, None])
        return SpikeStream(pack(np.diff(total, axis=0)), 32, 20, RATE_HZ)

    streams = tuple(record(radiance, 120, seed) for seed in range(3))
    one = Recordings(record(0.7, 500, 8), record(0.0, 2000, 9), 0.7)
    scene = replace(WORLD.training, streams=streams, recordings=(one,) * 3 if recordings else ())
    return scene


def test_gain_and_dark_charge_are_the_estimates_of_the_recordings() -> None:
    gain = np.random.default_rng(0).normal(1, 0.1, (20, 32))
    gain /= gain.mean()
    known, unknown = (SpikeCameras(gray_scene(0.4, gain, 0.004, r)) for r in (True, False))
    np.testing.assert_allclose(known.white.numpy(), np.broadcast_to(GAIN * gain, (3, 20, 32)), rtol=0.02)
    np.testing.assert_allclose(known.dark.numpy(), 0.004, rtol=0.05)
    assert torch.equal(unknown.white, torch.full((3, 20, 32), GAIN)) and not unknown.dark.any()
    image = torch.rand(2, 20, 32)
    torch.testing.assert_close(known.rate(image, (2, 0)), image * known.white[[2, 0]] + known.dark[[2, 0]])


@pytest.mark.parametrize("name", ["spike", "spss"])
def test_with_recordings_the_loss_is_least_for_the_light_and_not_for_the_pattern(name: str) -> None:
    gain = np.where(np.arange(32) % 2, 1.15, 0.85) * np.ones((20, 1))
    pattern = torch.from_numpy(0.4 * gain).float().expand(2, 20, 32)
    flat = torch.full((2, 20, 32), 0.4)
    for recordings in (True, False):
        loss = make(name, gray_scene(0.4, gain, 0.0, recordings))
        scores = [
            np.mean([float(loss(lambda t, i=i: i, sample(60, k, flat)).detach()) for k in range(4)])
            for i in (flat, pattern)
        ]
        if name == "spss":
            scores[1] -= 0.8 * float((pattern - flat).abs().mean()) + 0.2 * (1 - float(ssim(pattern, flat)))
        assert (scores[0] < scores[1]) == recordings


def test_one_binary_spike_draws_rates_to_one_half_and_a_value_of_many_ticks_to_the_right_rate() -> None:
    scene = gray_scene(0.3 / GAIN, np.ones((20, 32)), 0.0, False)  # 0.3 spikes per tick
    ends = {}
    for ticks in (1, 256):
        loss = spss.SpikeVariation(replace(SETTINGS, neuron_ticks=ticks), scene)
        slopes = []
        for rate in (0.26, 0.34, 0.46, 0.54):
            gray = torch.full((2, 20, 32), rate / GAIN, requires_grad=True)
            for step in range(6):
                loss(lambda t, g=gray: g, sample(60, step)).backward()
            assert gray.grad is not None
            slopes.append(float(gray.grad.sum()))
        ends[ticks] = [s > 0 for s in slopes]
    assert ends[256] == [False, True, True, True]
    assert ends[1] == [False, False, False, True]


def test_windows_hold_their_ticks_wherever_they_are() -> None:
    scene = WORLD.training
    for ticks, tick, expected in ((40, 60, (40, 80)), (1, 0, (0, 1)), (1, 119, (119, 120)), (7, 2, (0, 6))):
        counts, length = recorded(scene, sample(tick), ticks)
        first, last = expected
        spikes = np.stack([scene.streams[v].window(first, last).sum(0) for v in VIEWS])
        assert length == last - first
        np.testing.assert_array_equal(counts.numpy(), spikes)


def test_a_pixel_whose_image_is_no_number_teaches_nothing() -> None:
    target = truth(0.6) + 0.1
    target[0, 3, 4] = torch.nan
    target[1, 5, 6] = torch.inf
    image = truth(0.6).requires_grad_()
    loss = Pixel(PixelSettings(ssim_weight=0.0), WORLD.training)
    loss(lambda t: image, sample(60, 0, target)).backward()
    assert image.grad is not None and int((image.grad == 0).sum()) == 2
    assert not image.grad[0, 3, 4] and not image.grad[1, 5, 6]
