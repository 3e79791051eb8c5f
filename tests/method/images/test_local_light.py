"""A lamp beside steady light: its course, the shares of it that pixels see, and images of both layers."""

import numpy as np
import pytest
from lit_streams import RATE_HZ, lit

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.scene.camera_state import Clock
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.images.adaptive import ADAPTIVE
from spike4dgs.method.images.intervals import INTERVALS, intervals
from spike4dgs.method.images.light import Light, PixelLight, estimate_light
from spike4dgs.method.images.local_light import lamp, layers, shared

N, HEIGHT, WIDTH = 400, 48, 80


def flashes() -> Float64:
    """Return a lamp's course with mean 1: dark, a quick rise at ticks 90 and 230, and a slow fade."""
    since = np.subtract.outer(np.arange(N) + 0.5, [90, 230])
    rise = 1 - np.exp(-np.maximum(since, 0) / 4)
    found = (np.where(since > 0, rise * np.exp(-since / 36), 0)).sum(axis=1)
    return np.asarray(found / found.mean())


def world(seed: int = 0) -> tuple[Float64, Float64]:
    """Return mean rates and shares [H, W]: the lamp lights what is to the right by up to half, the rest by a tenth."""
    rng = np.random.default_rng(seed)
    shares = np.clip(np.linspace(-0.4, 0.6, WIDTH), 0.05, 0.5) * rng.uniform(0.8, 1, (HEIGHT, WIDTH))
    return rng.uniform(0.05, 0.3, (HEIGHT, WIDTH)), shares


def seen(course: Float64, seed: int = 0, moving: float = 0.0) -> SpikeStream:
    """Return the spikes of that world without noise; a share of its columns shows a texture that moves."""
    rates, shares = world(seed)
    return lit(course, rates, np.random.default_rng(seed + 100), shares, moving)


def gathered(course: Float64) -> Float64:
    return Light(course).gathered(Clock(), N)


def test_two_layers_of_still_pixels_come_back_in_closed_form() -> None:
    rates, shares = world()
    mean, change, rest = layers(seen(flashes()), gathered(flashes()))
    assert np.abs(mean - rates[::-1].ravel()).max() < 2e-3
    assert np.abs(change - (rates * shares)[::-1].ravel()).max() < 0.015
    assert np.sqrt(np.mean((change - (rates * shares)[::-1].ravel()) ** 2)) < 0.003
    assert rest.max() < 0.2


def test_the_kernel_is_its_float64_twin() -> None:
    """The twin is least squares over a pixel's spikes by NumPy."""
    stream = seen(flashes(), moving=0.5)
    found = np.stack(layers(stream, gathered(flashes())))
    spikes = stream.window(0, N)[:, ::-1].reshape(N, -1)  # as stored
    for p in range(0, HEIGHT * WIDTH, 41):
        ticks = np.flatnonzero(spikes[:, p])
        at = ticks + 0.5
        known = np.stack([np.ones_like(at), at, gathered(flashes())[ticks] - at], 1)
        (_, *expected), *_ = np.linalg.lstsq(known, np.arange(len(ticks)), rcond=None)
        rest = known @ np.linalg.lstsq(known, np.arange(len(ticks)), rcond=None)[0] - np.arange(len(ticks))
        np.testing.assert_allclose(found[:2, p], expected, rtol=1e-5, atol=1e-7)
        assert found[2, p] == pytest.approx(np.sqrt(np.mean(rest**2)), abs=1e-5)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("moving", [0.0, 0.2])
def test_a_local_lamp_is_told_from_one_light_for_all(moving: float, seed: int) -> None:
    local = estimate_light([seen(flashes(), seed, moving)], [Clock()])
    assert local is not None and local.local
    assert estimate_light([seen(np.ones(N), seed, moving)], [Clock()]) is None


@pytest.mark.parametrize("moving", [0.0, 0.2])
def test_the_course_of_a_lamp_comes_from_the_pixels_that_it_lights(moving: float) -> None:
    """It is known up to what of it is steady: here the lamp is off at times, which fixes that too."""
    streams, clocks, true = [seen(flashes(), seed, moving) for seed in range(6)], [Clock()] * 6, flashes()
    first = estimate_light(streams, clocks)
    assert first is not None
    found = lamp(streams, clocks, first)
    assert found.local and found.factors.mean() == pytest.approx(1) and found.factors.min() == pytest.approx(0)
    error = np.sqrt(np.mean((found.factors - true) ** 2)) / true.std()
    blurred = np.corrcoef(first.factors, true)[0, 1]
    assert error < 0.13 and np.corrcoef(found.factors, true)[0, 1] > max(blurred, 0.995)


def test_where_no_pixel_tells_a_lamp_the_course_that_blocks_show_is_the_light_of_all() -> None:
    """With spikes at random no pixel is as even as a still one: nothing can be said of shares."""
    (rates, shares), rng = world(), np.random.default_rng(7)
    chance = rates * (1 + shares * (flashes()[:, None, None] - 1))
    stream = SpikeStream(pack((rng.random(chance.shape) < chance).astype(np.uint8)), WIDTH, HEIGHT, RATE_HZ)
    first = estimate_light([stream], [Clock()])
    assert first is not None and first.local
    found = lamp([stream], [Clock()], first)
    assert not found.local and np.array_equal(found.factors, first.factors)


@pytest.mark.parametrize("maker", [ADAPTIVE, INTERVALS], ids=lambda m: m.name)
def test_images_show_the_light_of_their_tick(maker) -> None:
    """The exact twin is the world itself; light taken as the whole scene's is far from it."""
    (rates, shares), course, stream = world(), flashes(), seen(flashes())
    ticks = [60, 100, 120, 300]
    at = np.array([(course[t - 1] + course[t]) / 2 for t in ticks])[:, None, None]
    truth = rates * (1 + shares * (at - 1))
    light = shared(stream, gathered(course))
    own = maker.in_light(light)(stream, ticks, 1.0)
    assert np.abs(own - truth).mean() < 0.004
    most = 0.7 + 0.3 * course  # of the scene
    everyone = maker.in_light(PixelLight(gathered(most)))(stream, ticks, 1.0) * (0.7 + 0.3 * at)
    assert np.abs(everyone - truth).mean() > 10 * np.abs(own - truth).mean()


def test_a_still_pixel_has_an_empty_span_and_a_moving_one_its_own() -> None:
    stream = seen(flashes(), moving=0.5)
    light = shared(stream, gathered(flashes()))
    _, spans, _ = intervals(stream, 120, light=light)
    lengths: Float32 = spans[1] - spans[0]
    assert (lengths[:, WIDTH // 2 + 2 :] == 0).mean() > 0.95
    assert (lengths[:, : WIDTH // 2 - 2] > 0).mean() > 0.95


def test_pixels_of_few_spikes_have_no_share() -> None:
    dark = SpikeStream(pack(np.zeros((N, HEIGHT, WIDTH), np.uint8)), WIDTH, HEIGHT, RATE_HZ)
    light = shared(dark, gathered(flashes()))
    assert not light.shares.any() and light.shares.shape == (HEIGHT * WIDTH,)
    assert np.isfinite(ADAPTIVE.in_light(light)(dark, [50], 1.0)).all()
