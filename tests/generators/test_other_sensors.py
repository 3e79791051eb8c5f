"""A conventional camera and an event camera of the same scene."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spike4dgs.generators.other_sensors import EXPOSURE_S, FPS, THRESHOLD, events, exposures
from spike4dgs.generators.sensor.reference import tick_means


def smooth_keys(spacing, n_ticks, shape=(5, 7)):
    """Return keys of a slow, smooth pattern, monotone between keys almost everywhere."""
    ticks = np.arange(0, n_ticks + spacing, spacing)
    phase = np.random.default_rng(0).uniform(0, 6.3, shape)
    return (0.5 + 0.3 * np.sin(phase + ticks[:, None, None] / 150)).astype(np.float32), ticks.tolist()


@pytest.mark.parametrize("spacing", [1, 3, 10, 20])
def test_a_frame_is_the_mean_of_its_ticks(spacing):
    n, rate = 600, 20_000
    keys, ticks = smooth_keys(spacing, n)
    means = np.stack(list(tick_means(keys, ticks, n)))
    frames = list(exposures(keys, ticks, n, rate))
    assert [tick for tick, _ in frames] == [0, 333]
    length = round(EXPOSURE_S * rate)
    for tick, image in frames:
        assert image.dtype == np.float32 and image.shape == (5, 7)
        np.testing.assert_allclose(image, means[tick : tick + length].mean(0), atol=2e-4)  # the clamp at extrema


@pytest.mark.parametrize(("n_ticks", "count"), [(80, 0), (166, 0), (167, 1), (400, 1), (500, 2), (2000, 6)])
def test_only_whole_exposures(n_ticks, count):
    keys, ticks = smooth_keys(20, n_ticks)
    starts = [tick for tick, _ in exposures(keys, ticks, n_ticks, 20_000)]
    assert starts == [round(k * 20_000 / FPS) for k in range(count)]


def test_a_moving_edge_is_smeared_over_its_path():
    x = np.arange(60)
    ticks = list(range(0, 181, 4))
    keys = [np.clip((t * 0.1 + 10 - x), 0, 1)[None].astype(np.float32) for t in ticks]  # to the right, 0.1 px a tick
    (_, image), *_ = exposures(keys, ticks, 180, 20_000)
    ramp = (image[0] > 0.02) & (image[0] < 0.98)
    assert abs(ramp.sum() - 0.1 * 167) <= 2


RATE = 20_000


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


def test_a_static_scene_has_no_events():
    image = np.random.default_rng(0).random((6, 9), dtype=np.float32)
    assert len(events([image] * 4, [0, 5, 10, 15], 15, RATE).t) == 0


def test_events_after_the_clip_are_left_out():
    keys = [np.full((1, 1), v, np.float32) for v in (0.1, 0.1, 0.9)]
    assert len(events(keys, [0, 20, 40], 20, RATE).t) == 0
    assert len(events(keys, [0, 20, 40], 40, RATE).t) == 10
