"""Losses at the edges of what a camera records: no number in them, in their gradients or in what they train is lost."""

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from toy_world import GAIN, RATE_HZ, ToyWorld

from spike4dgs.baselines.recipes import PARTS
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.supervision.base import Sample, Supervision

SUPERVISIONS = PARTS.supervision

WIDTH, HEIGHT = 16, 12
CAMERAS = ToyWorld(width=WIDTH, height=HEIGHT, side=2).cameras[:3]
NAMES = sorted(SUPERVISIONS)
Maps = tuple[Calibration, ...] | None


def scene_of(spikes: np.ndarray, maps: Maps = None) -> TrainingScene:
    """A scene of three cameras from spikes [3, T, H, W]."""
    streams = tuple(SpikeStream(pack(s), WIDTH, HEIGHT, RATE_HZ) for s in spikes)
    scene = TrainingScene("edge", "edge", CAMERAS, streams, RATE_HZ, spikes.shape[1], GAIN)
    vars(scene)["calibrations"] = maps  # what the recordings would have given
    return scene


def usual(ticks: int = 80) -> np.ndarray:
    return np.random.default_rng(0).random((3, ticks, HEIGHT, WIDTH)) < 0.3


def one_camera_saw_nothing() -> TrainingScene:
    spikes = usual()
    spikes[1] = False
    return scene_of(spikes)


def no_number_in_one_map() -> TrainingScene:
    gain = np.ones((3, HEIGHT, WIDTH), np.float32)
    rate = np.full((3, HEIGHT, WIDTH), 0.002, np.float32)
    gain[1, :4], gain[1, 5], rate[2, 3], rate[1, 7] = np.nan, np.inf, np.nan, -np.inf
    return scene_of(usual(), tuple(Calibration(g, d, GAIN) for g, d in zip(gain, rate, strict=True)))


def dead_and_hot_pixels() -> TrainingScene:
    gain = np.ones((HEIGHT, WIDTH), np.float32)
    rate = np.zeros((HEIGHT, WIDTH), np.float32)
    gain[2], rate[4] = 0.0, 1.0
    return scene_of(usual(), (Calibration(gain, rate, GAIN),) * 3)


SCENES: dict[str, Callable[[], TrainingScene]] = {
    "dark": lambda: scene_of(np.zeros((3, 80, HEIGHT, WIDTH))),
    "saturated": lambda: scene_of(np.ones((3, 80, HEIGHT, WIDTH))),
    "one tick": lambda: scene_of(usual(1)),
    "100,000 ticks": lambda: scene_of(np.tile(usual(10), (1, 10_000, 1, 1))),
    "identical frames": lambda: scene_of(np.broadcast_to(usual(1), (3, 80, HEIGHT, WIDTH))),
    "one camera saw nothing": one_camera_saw_nothing,
    "no number in a map": no_number_in_one_map,
    "dead and hot pixels": dead_and_hot_pixels,
}
IMAGES = {"black": 0.0, "gray": 0.4, "white": 1.0, "glare": 1e4, "faint": 1e-12}


def check(loss: Supervision, scene: TrainingScene, gray: float = 0.3) -> None:
    """Loss and gradients are finite for every tick and rendered image, and parameters stay so in training."""
    for value in IMAGES.values():
        for tick in {0, scene.n_ticks // 2, scene.n_ticks - 1}:
            images = torch.full((2, HEIGHT, WIDTH), gray)
            images[0, 0, 0] = torch.nan
            image = torch.full((2, HEIGHT, WIDTH), value, requires_grad=True)
            now = Sample(tick / scene.n_ticks, tick, (1, 2), images, tick)
            result = loss(lambda t, i=image: i, now)
            loss.zero_grad(set_to_none=True)
            result.backward()
            assert result.isfinite() and image.grad is not None and image.grad.isfinite().all(), (value, tick)
            own = [p for group, _ in loss.groups().values() for p in group]
            assert all(p.grad is not None and p.grad.isfinite().all() for p in own), (value, tick)
            if own:
                torch.optim.Adam(own, lr=1e-2, eps=1e-15).step()
                assert all(p.isfinite().all() for p in own)


@pytest.mark.parametrize("scene_name", SCENES)
@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_lost_at_the_edges(name: str, scene_name: str) -> None:
    scene = SCENES[scene_name]()
    check(SUPERVISIONS[name](SUPERVISIONS[name].defaults, scene), scene)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("scene_name", ["dark", "saturated", "identical frames"])
def test_nothing_is_lost_in_windows_of_one_tick(name: str, scene_name: str) -> None:
    scene = SCENES[scene_name]()
    defaults = SUPERVISIONS[name].defaults
    ticks = {f.name: 1 for f in fields(defaults) if f.name in ("spike_ticks", "neuron_ticks")}
    check(SUPERVISIONS[name](replace(defaults, **ticks), scene), scene)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("scene_name", ["dark", "saturated", "no number in a map"])
def test_float32_gives_the_losses_of_float64(name: str, scene_name: str) -> None:
    scene = SCENES[scene_name]()
    rng = np.random.default_rng(1)
    shown, target = rng.uniform(0.02, 1.2, (2, 2, HEIGHT, WIDTH))
    values, gradients = [], []
    for dtype in (torch.float32, torch.float64):
        loss = SUPERVISIONS[name](SUPERVISIONS[name].defaults, scene).to(dtype)
        image = torch.from_numpy(shown).to(dtype).requires_grad_()
        now = Sample(0.5, 40, (0, 1), torch.from_numpy(target).to(dtype), 2)
        result = loss(lambda t, i=image: i, now)
        result.backward()
        assert result.dtype == dtype and image.grad is not None
        values.append(float(result.detach()))
        gradients.append(image.grad.double())
    # A charge within rounding of the threshold may fire in one and not in the other: a spike of 80 x 384 in windows.
    assert values[0] == pytest.approx(values[1], rel=1e-4)
    assert float((gradients[0] - gradients[1]).norm()) < 2e-3 * float(gradients[1].norm())
