"""Spike rendering against neurons that are run tick by tick in float64."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from toy_world import GAIN, ToyWorld, run_neurons

from spike4dgs.baselines.recipes import PARTS
from spike4dgs.baselines.spike_render import SpikeRender, SpikeRenderSettings
from spike4dgs.benchmark.scene.camera_state import CameraState
from spike4dgs.benchmark.spikes.sensor_model import fired
from spike4dgs.method.supervision.base import Sample
from spike4dgs.method.supervision.spike_cameras import fire

SUPERVISIONS = PARTS.supervision

WORLD = ToyWorld(width=32, height=20, side=2, n_ticks=120)
SETTINGS = SpikeRenderSettings()


@pytest.mark.parametrize("ticks", [1, 7, 40])
def test_counts_are_those_of_neurons_run_tick_by_tick(ticks: int) -> None:
    rng = np.random.default_rng(0)
    rate, charge = rng.uniform(-0.2, 1.3, 4000), rng.random(4000)
    counts = fire(torch.from_numpy(rate), torch.from_numpy(charge), ticks).numpy()
    np.testing.assert_array_equal(counts, run_neurons(rate, charge, ticks))


def test_surrogate_gradient_is_that_of_the_mean_count_over_all_charges() -> None:
    ticks, step = 40, 1e-3
    charge = (np.arange(20000) + 0.5) / 20000
    rates = np.linspace(0.03, 0.97, 11)

    def mean_count(rate: float) -> float:
        return float(run_neurons(np.full(charge.shape, rate), charge, ticks).mean())

    numeric = [(mean_count(r + step) - mean_count(r - step)) / (2 * step) for r in rates]
    leaf = torch.from_numpy(rates).requires_grad_()
    fire(leaf, torch.full((11,), 0.5).double(), ticks).sum().backward()
    assert leaf.grad is not None
    np.testing.assert_allclose(leaf.grad.numpy(), numeric, rtol=2e-3)


def test_rates_beyond_the_cameras_range_are_still_drawn_back() -> None:
    rate = torch.tensor([-0.1, 1.4]).requires_grad_()
    (fire(rate, torch.zeros(2), 10) - torch.tensor([3.0, 7.0])).abs().sum().backward()
    assert rate.grad is not None and rate.grad[0] < 0 < rate.grad[1]


def scene_loss(settings: SpikeRenderSettings = SETTINGS) -> SpikeRender:
    loss = SUPERVISIONS["spike-render"](settings, WORLD.training)
    assert isinstance(loss, SpikeRender)
    return loss


def sample(tick: int, step: int = 0, views: tuple[int, ...] = (0, 2)) -> Sample:
    return Sample(tick / WORLD.n_ticks, tick, views, torch.zeros(len(views), 20, 32), step)


@pytest.mark.parametrize("tick", [3, 60, 118])
def test_the_right_image_fires_about_what_was_recorded(tick: int) -> None:
    loss, cameras = scene_loss(), WORLD.training.cameras

    def truth(t: float) -> torch.Tensor:
        return torch.from_numpy(np.stack([WORLD.trace(cameras[v], t)[0] for v in (0, 2)])).float()

    right = float(loss(truth, sample(tick)).detach())
    brighter, darker = (float(loss(lambda t, f=f: truth(t) + f, sample(tick)).detach()) for f in (0.1, -0.1))
    assert right < 0.06 and brighter > right + 0.04 and darker > right + 0.04


@pytest.mark.parametrize(("gain", "dead_ticks"), [(1.0, 0.0), (1.2, 0.0), (1.0, 0.5)])
def test_expected_loss_is_least_at_the_recorded_rate(gain: float, dead_ticks: float) -> None:
    """Of cameras whose own gain is another one, too, and of those that gather no light after a spike."""
    rate = fired(0.437 * GAIN * gain, dead_ticks)
    streams = tuple(_flat(rate, seed, dead_ticks) for seed in range(3))
    states = {camera.id: CameraState(gain=gain) for camera in WORLD.training.cameras}
    scene = replace(WORLD.training, streams=streams, states=states)
    loss = SpikeRender(replace(SETTINGS, ssim_weight=0.0), scene)
    gradients = []
    for value in (0.427, 0.437, 0.447):  # within one spike of a window, which is 0.042 of white
        gray = torch.full((3, 20, 32), value, requires_grad=True)
        for step in range(40):
            loss(lambda t, g=gray: g, sample(60, step, (0, 1, 2))).backward()
        assert gray.grad is not None
        gradients.append(float(gray.grad.sum()) / 40)
    assert gradients[0] < -0.1 and gradients[2] > 0.1 and abs(gradients[1]) < 0.1


def _flat(rate: float, seed: int, dead_ticks: float) -> SimpleNamespace:
    """A stream of neurons that all see one radiance, from random charges."""
    charge = np.random.default_rng(seed).random((20, 32))

    def counts(start: int, stop: int) -> np.ndarray:
        return (np.floor(charge + rate * stop) - np.floor(charge + rate * start)).astype(np.uint16)

    return SimpleNamespace(counts=counts, width=32, height=20, gaps=(), dead_ticks=dead_ticks)


def test_noise_embedding_scales_and_lifts_its_own_view_only() -> None:
    loss = scene_loss(replace(SETTINGS, noise_weight=0.0))
    image = torch.full((2, 20, 32), 0.5)
    with torch.no_grad():
        loss.noise[1] = 5.0  # a view that is not in the sample
    before = float(loss(lambda t: image, sample(60)).detach())
    with torch.no_grad():
        loss.noise[[0, 2], 0], loss.noise[[0, 2], 1] = float(np.log(2.0)), 0.1
    after = float(loss(lambda t: (image - 0.1) / 2, sample(60)).detach())
    assert after == pytest.approx(before, rel=1e-3)
    loss(lambda t: image, sample(60)).backward()
    assert loss.noise.grad is not None and loss.noise.grad[[0, 2]].abs().sum() > 0 and not loss.noise.grad[1].any()


def test_embedding_is_trained_and_kept_small() -> None:
    loss = scene_loss()
    ((leaf,), rate) = loss.groups()["noise"]
    assert leaf is loss.noise and rate.at(0.5) == pytest.approx(SETTINGS.lr_noise)
    with torch.no_grad():
        loss.noise.fill_(0.2)
    heavy, free = (float(scene_with(w, loss)) for w in (1.0, 0.0))
    assert heavy - free == pytest.approx(0.04, rel=1e-4)


def scene_with(weight: float, other: SpikeRender) -> torch.Tensor:
    loss = scene_loss(replace(SETTINGS, noise_weight=weight))
    loss.load_state_dict(other.state_dict())
    value: torch.Tensor = loss(lambda t: torch.full((2, 20, 32), 0.4), sample(60))
    return value.detach()


def test_one_step_one_loss() -> None:
    loss, image = scene_loss(), torch.full((2, 20, 32), 0.4)
    values = [float(loss(lambda t: image, sample(60, step)).detach()) for step in (7, 7, 8)]
    assert values[0] == values[1] != values[2]
