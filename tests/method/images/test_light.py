"""The course of the light from a clip, and images in mean light."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lit_streams import RATE_HZ, lit

from spike4dgs.benchmark.scene.camera_state import Clock
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.images.adaptive import ADAPTIVE, half_windows, shared_levels
from spike4dgs.method.images.intervals import INTERVALS
from spike4dgs.method.images.light import Light, PixelLight, estimate_light, steady

N, HEIGHT, WIDTH = 400, 48, 80


def course(depth: float, hz: float = 100.0, n: int = N) -> np.ndarray:
    """Return the mean factors of a sine over each tick, with mean 1 over whole periods."""
    at = np.arange(n + 1) / RATE_HZ
    integral = at - depth * np.cos(2 * np.pi * hz * at + 0.7) / (2 * np.pi * hz)
    return np.diff(integral) * RATE_HZ


def stream_in(light: np.ndarray, moving: float = 0.0, seed: int = 0, dead: int = 0) -> SpikeStream:
    """Return the spikes of a scene of random rates under a light; a share of its columns shows a texture that moves."""
    rng = np.random.default_rng(seed)
    return lit(light, rng.uniform(0.05, 0.5, (HEIGHT, WIDTH)), rng, moving=moving, dead=dead)


@pytest.mark.parametrize("moving", [0.0, 0.6])
@pytest.mark.parametrize("depth", [0.04, 0.3])
def test_a_flicker_is_found_next_to_motion(depth, moving):
    true = course(depth)
    light = estimate_light([stream_in(true, moving, seed) for seed in range(3)], [Clock()] * 3)
    assert light is not None and not light.local and light.factors.mean() == pytest.approx(1)
    assert np.sqrt(np.mean((light.factors - true / true.mean()) ** 2)) < 0.006


@pytest.mark.parametrize("depth", [0.08, 0.5])
def test_a_flicker_is_as_deep_as_it_is_where_ticks_are_dead(depth):
    """Of 8 ticks a pixel fires in 2 at most, when 4 are dead after each. Textured blocks lose a tenth of it."""
    simulated = [stream_in(course(depth, n=N + 40), seed=seed, dead=4) for seed in range(3)]
    streams = [replace(s, packed=s.packed[40:]) for s in simulated]  # at first no pixel is dead
    light, true = estimate_light(streams, [Clock()] * 3), course(depth, n=N + 40)[40:] - 1
    assert light is not None
    assert (light.factors - 1) @ true / (true @ true) == pytest.approx(1, abs=0.12)


@given(moving=st.sampled_from([0.0, 0.3, 0.7]), seed=st.integers(0, 2**31))
@settings(max_examples=12, deadline=None)
def test_steady_light_is_left_alone_whatever_moves(moving, seed):
    assert estimate_light([stream_in(np.ones(N), moving, seed)], [Clock()]) is None


def test_clips_that_say_nothing_have_steady_light():
    dark = SpikeStream(pack(np.zeros((N, HEIGHT, WIDTH), np.uint8)), WIDTH, HEIGHT, RATE_HZ)
    assert estimate_light([dark], [Clock()]) is None
    small = SpikeStream(pack(np.ones((N, 8, 8), np.uint8)), 8, 8, RATE_HZ)
    assert estimate_light([small], [Clock()]) is None
    assert estimate_light([stream_in(course(0.3)[:20])], [Clock()]) is None


def test_a_late_camera_has_its_part_of_the_light():
    true = course(0.2, n=N + 40)
    late = Clock(offset_ticks=-40.0)  # at the array's tick s it is at s - 40: its clip begins 40 ticks later
    streams = [stream_in(true[:N], seed=1), stream_in(true[40:], seed=2), stream_in(true[:N], seed=3)]
    light = estimate_light(streams, [Clock(), late, Clock()])
    assert light is not None
    exact = Light(true[:N] / true[:N].mean())
    steps = np.diff(exact.gathered(late, N))
    np.testing.assert_allclose(steps[: N - 41], true[41:N] / true[:N].mean(), atol=0.01)
    assert np.abs(np.diff(light.gathered(late, N))[: N - 41] - steps[: N - 41]).mean() < 0.01


def test_gathered_light_is_the_integral_of_the_factors():
    steady = Light(np.ones(N))
    np.testing.assert_allclose(steady.gathered(Clock(), N), np.arange(N) + 0.5)
    np.testing.assert_allclose(steady.gathered(Clock(3.0), N), np.arange(N) + 0.5)
    light = Light(course(0.3))
    np.testing.assert_allclose(light.gathered(Clock(), N), np.cumsum(light.factors) - light.factors / 2)


@pytest.mark.parametrize("maker", [ADAPTIVE, INTERVALS], ids=lambda m: m.name)
def test_images_of_still_pixels_are_those_of_mean_light(maker):
    """The slow twin is the same scene in steady light: the longest window fits, and no motion is seen."""
    true = course(0.5)
    lit, even = stream_in(true), stream_in(np.ones(N))
    light = PixelLight(Light(true / true.mean()).gathered(Clock(), N))
    known, ticks = maker.in_light(light), [5, 60, 200, 333, 396]
    found, expected, naive = known(lit, ticks, 1.0), maker(even, ticks, 1.0), maker(lit, ticks, 1.0)
    assert np.abs(found - expected).mean() < 0.0006
    assert np.abs(naive - expected).mean() > 5 * np.abs(found - expected).mean()
    assert all((shared_levels(lit, tick, maker.settings, light) == len(half_windows(N)) - 1).all() for tick in ticks)


def test_steady_light_gives_the_bits_of_none():
    stream = stream_in(course(0.1), moving=0.5)
    for maker in (ADAPTIVE, INTERVALS):
        lit = maker.in_light(steady(N))
        assert lit(stream, [3, 200, 397], 1.0).tobytes() == maker(stream, [3, 200, 397], 1.0).tobytes()
