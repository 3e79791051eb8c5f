"""A conventional camera and an event camera of the same scene."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spike4dgs.benchmark.scene.images import decode_srgb, read_png
from spike4dgs.cli.make_dataset import physics_of
from spike4dgs.generators import other_sensors, streams
from spike4dgs.generators.make_dataset import SceneSettings
from spike4dgs.generators.other_sensors import THRESHOLD, EventNoise, events, exposures
from spike4dgs.generators.render_tasks import cameras_of
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.keyframes import Clip
from spike4dgs.generators.sensor.reference import tick_means

RATE = 20_000


class Gray:
    """A store of keys that shows radiance 0.4 at every tick."""

    def instants(self, view, plan):
        return Clip([np.full((40, 64), 0.4, np.float32)] * len(plan.ticks), plan.ticks)

    view = instants

    def at(self, view, plan):
        return lambda tick: np.full((40, 64), 0.4, np.float32)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_frame_has_the_mean_of_light_that_flickers_faster_than_ticks(seed, tmp_path):
    """At 10 kHz, the light at the starts of ticks is high in every second one, or in none."""
    job = physics_of("flicker=1 flicker-hz=10000 flicker-duty=0.3")
    job = SceneSettings(profile="tiny", seconds=0.009, seed=seed, physics=job).job("car")
    streams.write_camera(tmp_path, job, cameras_of(job)[0], Gray(), 0, KeyPlan(180, RATE, 0.5, (20,)))
    (file,) = (tmp_path / "conventional").rglob("*.png")
    frame = decode_srgb(read_png(file))
    assert np.abs(frame - 0.4 * np.mean([job.flicker.mean(t) for t in range(167)])).max() < 0.005
    assert frame.mean() == pytest.approx(0.4, rel=0.02)


def smooth_keys(spacing, n_ticks, shape=(5, 7)):
    """Return keys of a slow, smooth pattern, monotone between keys almost everywhere."""
    ticks = np.arange(0, n_ticks + spacing, spacing)
    phase = np.random.default_rng(0).uniform(0, 6.3, shape)
    return (0.5 + 0.3 * np.sin(phase + ticks[:, None, None] / 150)).astype(np.float32), ticks.tolist()


@pytest.mark.parametrize("spacing", [1, 3, 10, 20])
def test_a_frame_is_the_mean_of_its_ticks(spacing):
    keys, ticks = smooth_keys(spacing, 600)
    means = np.stack(list(tick_means(keys, ticks, 600)))
    frames = list(exposures(keys, ticks, 600, RATE))
    assert [tick for tick, _ in frames] == [0, 333]
    length = round(other_sensors.EXPOSURE_S * RATE)
    for tick, image in frames:
        assert image.dtype == np.float32 and image.shape == (5, 7)
        np.testing.assert_allclose(image, means[tick : tick + length].mean(0), atol=2e-4)  # the clamp at extrema


@pytest.mark.parametrize(("n_ticks", "count"), [(80, 0), (166, 0), (167, 1), (400, 1), (500, 2), (2000, 6)])
def test_only_whole_exposures(n_ticks, count):
    keys, ticks = smooth_keys(20, n_ticks)
    starts = [tick for tick, _ in exposures(keys, ticks, n_ticks, 20_000)]
    assert starts == [round(k * 20_000 / other_sensors.FPS) for k in range(count)]


def test_a_moving_edge_is_smeared_over_its_path():
    x = np.arange(60)
    ticks = list(range(0, 181, 4))
    keys = [np.clip((t * 0.1 + 10 - x), 0, 1)[None].astype(np.float32) for t in ticks]  # to the right, 0.1 px a tick
    (_, image), *_ = exposures(keys, ticks, 180, 20_000)
    ramp = (image[0] > 0.02) & (image[0] < 0.98)
    assert abs(ramp.sum() - 0.1 * 167) <= 2


def plain_events(keys, ticks, threshold):
    """Return the events of the model, one pixel and one event after the other, at exact times."""
    logs = np.log(np.maximum(np.asarray(keys, np.float64), 1e-3))
    found = []
    for y, x in np.ndindex(*logs.shape[1:]):
        level = logs[0, y, x]
        for k in range(len(ticks) - 1):
            a, b = logs[k, y, x], logs[k + 1, y, x]
            while abs(b - level) >= threshold and a != b:
                level += threshold * np.sign(b - level)
                share = min(max((level - a) / (b - a), 0), 1)
                t = (ticks[k] + share * (ticks[k + 1] - ticks[k])) * 1e6 / RATE
                found.append((t, y, x, int(b > a)))
    return sorted(found)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 5), st.integers(1, 6), st.integers(2, 8), st.sampled_from([0.1, 0.2, 0.5]), st.integers(0, 2**31))
def test_events_are_those_of_a_plain_loop(height, width, n, threshold, seed):
    rng = np.random.default_rng(seed)
    keys = np.exp(rng.normal(-1, 0.5, (n, height, width))).astype(np.float32)
    ticks = np.cumsum([0, *rng.integers(1, 21, n - 1)]).tolist()
    found, expected = events(keys, ticks, ticks[-1] + 1, RATE, threshold), plain_events(keys, ticks, threshold)
    assert len(found.t) == len(expected)
    assert (np.diff(found.t) >= 0).all()
    key = lambda rows: sorted((y, x, p, round(t)) for t, y, x, p in rows)  # noqa: E731
    ours = key(zip(found.t, found.y, found.x, found.p, strict=True))
    for a, b in zip(ours, key(expected), strict=True):
        assert a[:3] == b[:3] and abs(a[3] - b[3]) <= 2
    # the light reconstructed from events is within a threshold of the truth
    logs = np.log(np.maximum(keys.astype(np.float64), 1e-3))
    rebuilt = logs[0].copy()
    np.add.at(rebuilt, (found.y, found.x), threshold * (2.0 * found.p - 1))
    assert np.abs(rebuilt - logs[-1]).max() < threshold + 1e-9


def test_a_ramp_has_as_many_events_as_thresholds():
    growth = np.array([[0.0, 0.5, 1.05, -0.7]])
    keys = [np.exp(-1 + growth * k / 4).astype(np.float32) for k in range(5)]
    found = events(keys, [0, 20, 40, 60, 80], 80, RATE)
    for x, total in enumerate(growth[0]):
        mine = found.x == x
        assert mine.sum() == int(abs(total) / THRESHOLD + 1e-6)
        assert (found.p[mine] == (total > 0)).all()
        ideal = 4000 * THRESHOLD * np.arange(1, mine.sum() + 1) / max(abs(total), 1e-9)
        assert np.abs(found.t[mine] - ideal).max(initial=0) <= 2


def test_events_after_the_clip_are_left_out():
    keys = [np.full((1, 1), v, np.float32) for v in (0.1, 0.1, 0.9)]
    assert len(events(keys, [0, 20, 40], 20, RATE).t) == 0
    assert len(events(keys, [0, 20, 40], 40, RATE).t) == 10


def rng(seed=0):
    return np.random.default_rng(seed)


def test_a_noisy_frame_has_the_noise_of_the_data_sheets():
    """Shot noise of 10,700 electrons at white is 40.3 dB; in the dark the read noise is left, 71.3 dB below white."""
    noise, shape = other_sensors.FrameNoise(full_well=10_700), (300, 400)
    for radiance in (0.0, 0.05, 0.4):
        image = other_sensors.noisy_frame(np.full(shape, radiance, np.float32), noise, rng()).astype(np.float64)
        if radiance:
            assert abs(image.mean() - radiance) < 4 * image.std() / np.sqrt(image.size)
            assert image.std() == pytest.approx(np.sqrt(radiance * 10_700 + 2.9**2) / 10_700, rel=0.02)
        else:  # what is below black is clipped
            assert np.sqrt(2 * np.square(image).mean()) == pytest.approx(10 ** (-71.3 / 20), rel=0.02)
    bright = other_sensors.noisy_frame(np.full(shape, 1.5, np.float32), noise, rng())
    assert (bright == 1).all() and bright.dtype == np.float32


def test_thresholds_differ_from_pixel_to_pixel_and_by_sign():
    """A ramp of many thresholds tells each pixel's own: its log radiance over its number of events."""
    shape, ramp = (40, 50), 60.0
    quiet = EventNoise(shot_hz=0, refractory_us=0)
    found = {}
    for p, keys in ((1, [1e-3, 1e-3 * np.exp(ramp)]), (0, [1e-3 * np.exp(ramp), 1e-3])):
        images = [np.full(shape, k, np.float64) for k in keys]
        e = events(images, [0, 20], 20, RATE, noise=quiet, rng=rng())
        assert (e.p == p).all()
        found[p] = ramp / np.bincount(e.y.astype(int) * 50 + e.x, minlength=2000)
    for threshold in found.values():
        assert threshold.mean() == pytest.approx(THRESHOLD, abs=0.005)
        assert threshold.std() == pytest.approx(quiet.mismatch, rel=0.06)
    assert abs(np.corrcoef(*found.values())[0, 1]) < 0.1


def test_a_refractory_pixel_sends_fewer_events_and_none_too_early():
    keys = [np.full((1, 1), v, np.float64) for v in (1e-3, 1e-3 * np.exp(8.1))]
    every = events(keys, [0, 200], 200, RATE)  # 40 events in 10 ms, 247 us apart
    calm = events(keys, [0, 200], 200, RATE, noise=EventNoise(0, shot_hz=0, refractory_us=450), rng=rng())
    assert len(every.t) == 40 and len(calm.t) == 22 and np.diff(calm.t).min() >= 450


def watched_events(keys, ticks, refractory_us):
    """Return [time, pixel, polarity] of pixels that are looked at in every microsecond outside their dead time."""
    logs = np.log(np.asarray(keys, np.float64)).reshape(len(keys), -1)
    level, last, found = logs[0].copy(), np.full(logs.shape[1], -np.inf), []
    for now in range(round(ticks[-1] * 1e6 / RATE)):
        k = np.searchsorted(ticks, now * RATE / 1e6, side="right") - 1
        share = (now * RATE / 1e6 - ticks[k]) / (ticks[k + 1] - ticks[k])
        off = logs[k] + share * (logs[k + 1] - logs[k]) - level
        (sends,) = np.nonzero((now - last >= refractory_us) & (np.abs(off) >= THRESHOLD))
        level[sends] += THRESHOLD * np.sign(off[sends])
        last[sends] = now
        found += [(now, i, int(off[i] > 0)) for i in sends]
    return np.array(found)


def test_a_change_inside_the_refractory_period_is_told_after_it():
    """As in v2e, whose pixels store only what they send. Light swings by several thresholds within each period."""
    keys, ticks = np.exp(rng().normal(-2, 0.7, (12, 4, 5))), [0, 1, 3, 4, 13, 20, 21, 30, 50, 52, 53, 60, 140]
    keys, quiet = np.concatenate([keys, keys[-1:]]), EventNoise(0, shot_hz=0, refractory_us=500)
    found, expected = events(keys, ticks, 140, RATE, noise=quiet, rng=rng()), watched_events(keys, ticks, 500)
    assert len(found.t) == len(expected) > 100
    for i in range(20):
        mine, theirs = found.y.astype(int) * 5 + found.x == i, expected[expected[:, 1] == i]
        assert (found.p[mine] == theirs[:, 2]).all()
        assert np.abs(found.t[mine].astype(int) - theirs[:, 0]).max() < 10  # microseconds add up
    rebuilt = np.log(keys[0])
    np.add.at(rebuilt, (found.y, found.x), THRESHOLD * (2.0 * found.p - 1))
    assert np.abs(rebuilt - np.log(keys[-1])).max() < THRESHOLD + 1e-9, "all is told once the light is still"


@pytest.mark.parametrize(("radiance", "share"), [(0.0, 1.0), (0.5, 0.625), (1.0, 0.25)])
def test_shot_events_come_at_their_rate_and_in_order(radiance, share):
    image, noise = np.full((100, 100), radiance, np.float32), EventNoise()
    found = events([image] * 5, [0, 500, 900, 1500, 2000], 2000, RATE, noise=noise, rng=rng())
    expected = 10_000 * 0.1 * noise.shot_hz * share  # in 0.1 s
    assert abs(len(found.t) - expected) < 4 * np.sqrt(expected)
    assert abs(int(found.p.sum()) - len(found.t) / 2) < 2 * np.sqrt(expected)
    assert (np.diff(found.t) >= 0).all() and 0 <= found.t[0] and found.t[-1] < 100_000
    assert abs(found.t.mean() - 50_000) < 4 * 100_000 / np.sqrt(12 * expected)
    assert len(np.unique(found.y.astype(int) * 100 + found.x)) > expected / 2
