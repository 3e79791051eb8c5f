"""The survey before a fit: gaps, bad pixels and gains of a toy world that has them, against one that does not."""

from dataclasses import replace

import numpy as np
import pytest
from toy_world import GAIN, ToyWorld

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.calibration import Recordings
from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.images.training import ImageSettings, make_training_images
from spike4dgs.method.recordings import survey
from spike4dgs.method.recordings.camera_facts import log_gains, shrunk
from spike4dgs.method.recordings.survey import survey_gains, survey_streams

WORLD = ToyWorld(width=96, height=60, n_ticks=200, travel=0.0, seed=1)
SCENE = WORLD.training
NAMES = [c.id for c in SCENE.cameras]


def changed(index, change, gaps=()):
    """Return the scene with the spikes of one camera changed, [T, H, W], and its gaps as the recorder leaves them."""
    stream = SCENE.streams[index]
    spikes = change(stream.window(0, stream.n_ticks).copy())
    for first, ticks in gaps:
        spikes[first : first + ticks] = 0
    found = tuple(Gap(NAMES[index], first, ticks, "overflow") for first, ticks in gaps)
    new = SpikeStream(pack(spikes), stream.width, stream.height, stream.rate_hz, gaps=found)
    return replace(SCENE, streams=tuple(new if i == index else s for i, s in enumerate(SCENE.streams)))


def recordings(bad=None, gain=1.0):
    """Return recordings of even pixels; those in the mask never fire."""
    rng = np.random.default_rng(0)

    def even(rate):
        charge = rng.random(rate.shape) + np.arange(401)[:, None, None] * rate
        return SpikeStream(pack(np.diff(np.floor(charge), axis=0)), WORLD.width, WORLD.height, 20000.0)

    light = np.full((WORLD.height, WORLD.width), 0.7 * GAIN * gain)
    return Recordings(even(light if bad is None else light * ~bad), even(np.full_like(light, 0.005)), 0.7)


def test_a_perfect_recording_is_left_as_it_is():
    found = survey_streams(SCENE)
    assert found.scene.streams == SCENE.streams and not found.notes
    assert found.scene.states == {} and set(found.bad) == set(NAMES)


def test_gains_of_uniform_light_that_differ_by_orders_of_magnitude_are_refused():
    light = [recordings(gain=0.02), *[recordings()] * (len(NAMES) - 1)]
    with pytest.raises(UserError, match=f"gains that differ by less than 30 times, found .* of {NAMES[0]}"):
        survey_gains(replace(SCENE, recordings=tuple(light)))


def test_single_missing_ticks_cost_next_to_nothing():
    gaps = [(t, 1) for t in (3, 50, 51, 120, 199)]
    scene = changed(1, lambda s: s, gaps)
    found = survey_streams(scene)
    assert found.notes == ("5 ticks are missing (0.31% of all): filled from the spikes around them",)
    settings = ImageSettings()
    clean, bare, filled = (
        make_training_images(s, s.cameras, IMAGES["tfp"], settings, "cpu") for s in (SCENE, scene, found.scene)
    )
    error = [float((x.images[:, 1] - clean.images[:, 1]).abs().mean()) for x in (bare, filled)]
    assert error[1] < 0.25 * error[0]
    assert filled.missing is None and filled.measured(2).isfinite().all()


def test_images_in_a_long_gap_are_left_out_of_the_loss():
    found = survey_streams(changed(2, lambda s: s, [(60, 80)]))
    images = make_training_images(found.scene, found.scene.cameras, IMAGES["tfp"], ImageSettings(), "cpu")
    assert images.images.isfinite().all(), "detectors get numbers"
    unknown = np.array(
        [[bool(images.measured(i)[c].isnan().all()) for c in range(len(NAMES))] for i in range(len(images.ticks))]
    )
    assert not unknown[:, [0, 1, 3]].any()
    inside = [60 <= t < 140 for t in images.ticks]
    assert (unknown[:, 2] == inside).mean() > 0.9 and unknown[:, 2].any()
    assert f"{NAMES[2]} lacks ticks [60, 140)" in found.notes[1]


def test_a_camera_that_lacks_most_ticks_is_left_out():
    found = survey_streams(changed(0, lambda s: s, [(40, 160)]))
    assert [c.id for c in found.scene.cameras] == NAMES[1:]
    assert f"{NAMES[0]} lacks 80% of its ticks: left out" in found.notes
    gap = (Gap("x", 0, 200, "stall"),)
    with pytest.raises(UserError, match="two cameras that recorded spikes, in most ticks"):
        survey_streams(replace(SCENE, streams=tuple(replace(s, gaps=gap) for s in SCENE.streams)))


def test_bad_pixels_are_filled_and_left_out_of_the_loss():
    bad = np.zeros((WORLD.height, WORLD.width), bool)
    bad[10, 20] = bad[30, 40] = bad[30, 41] = True
    scene = replace(
        changed(1, lambda s: s * ~bad), recordings=tuple(recordings(bad if i == 1 else None) for i in range(len(NAMES)))
    )
    found = survey_streams(scene)
    np.testing.assert_array_equal(found.scene.state(NAMES[1]).bad, bad)
    assert found.scene.state(NAMES[0]).bad is None
    assert "3 dead, 0 hot, 0 flickering (from recordings)" in found.notes[0]
    for flat_field in (False, True):
        settings = ImageSettings(flat_field=flat_field)
        images = make_training_images(found.scene, found.scene.cameras, IMAGES["tfp"], settings, "cpu")
        assert images.images.isfinite().all()
        measured = images.measured(3).numpy()
        np.testing.assert_array_equal(np.isnan(measured[1]), bad)
        assert np.isfinite(measured[0]).all()
        clean = make_training_images(SCENE, SCENE.cameras, IMAGES["tfp"], ImageSettings(), "cpu").images[:, 1][:, bad]
        assert float((images.images[:, 1][:, bad] - clean).abs().mean()) < 0.2, "a neighbour's, not black"


def test_cameras_whose_pixels_are_mostly_bad_are_left_out_as_they_are_but_two_must_be_good(monkeypatch):
    column = np.broadcast_to(np.arange(WORLD.width) / WORLD.width, (WORLD.height, WORLD.width))
    dead, hot, good = column < 0.4, column > 0.6, recordings()
    broken = Recordings(recordings(dead).flat, recordings(~hot).flat, 0.7)
    filled, fill = [], survey.fill_pixels
    monkeypatch.setattr(survey, "fill_pixels", lambda stream, mask: filled.append(mask.mean()) or fill(stream, mask))
    found = survey_streams(replace(SCENE, recordings=(broken, *[good] * (len(NAMES) - 1))))
    assert [c.id for c in found.scene.cameras] == NAMES[1:] and len(found.scene.recordings) == len(NAMES) - 1
    assert f"most pixels of {NAMES[0]} are bad: left out" in found.notes and max(filled) < 0.5
    with pytest.raises(UserError, match="expected two cameras most of whose pixels work, found 1"):
        survey_streams(replace(SCENE, recordings=(good, *[broken] * (len(NAMES) - 1))))


def test_log_gains_are_found_among_outliers_and_hidden_points():
    rng = np.random.default_rng(0)
    truth = np.array([0.05, -0.03, 0.0, 0.02, -0.04])
    logs = truth[:, None] + rng.normal(size=2000) + 0.03 * rng.normal(size=(5, 2000))
    logs[rng.random(logs.shape) < 0.1] += 1.0
    logs[rng.random(logs.shape) < 0.3] = np.nan
    logs = logs[:, np.isfinite(logs).sum(axis=0) >= 2]
    np.testing.assert_allclose(log_gains(logs), truth, atol=0.01)


def test_differences_as_small_as_the_estimates_own_error_are_no_gains():
    np.testing.assert_array_equal(shrunk(np.array([0.995, 1.005, 1.0])), 1)
    np.testing.assert_allclose(shrunk(np.array([0.9, 1.1])), [0.901, 1.099])


def test_gains_come_from_uniform_light():
    rates = np.array([1.02, 0.98, 1.01, *[1.0] * (len(NAMES) - 3)])
    found, notes = survey_gains(replace(SCENE, recordings=tuple(recordings(gain=rate) for rate in rates)))
    np.testing.assert_allclose([found.state(c).gain for c in NAMES], rates / rates.mean(), atol=0.003)
    assert "from the recordings of uniform light" in notes[0]


def test_gains_come_from_the_views():
    rates = [1.0, 1.08, 1.0, 0.96, *[1.0] * len(NAMES)][: len(NAMES)]
    streams = []
    for stream, rate in zip(SCENE.streams, rates, strict=True):
        light = stream.window(0, stream.n_ticks).mean(0) * rate
        charge = np.random.default_rng(3).random(light.shape) + np.arange(201)[:, None, None] * light
        packed = pack(np.diff(np.floor(charge), axis=0))
        streams.append(SpikeStream(packed, stream.width, stream.height, stream.rate_hz))
    scene = replace(SCENE, streams=tuple(streams))
    found, notes = survey_gains(scene)
    expected = np.array(rates) / np.mean(rates)
    np.testing.assert_allclose([found.state(c).gain for c in NAMES], expected, atol=0.02)
    assert "from points that several cameras see" in notes[0]
    images = (make_training_images(s, s.cameras, IMAGES["tfp"], ImageSettings(), "cpu").images for s in (scene, found))
    own, corrected = (each.mean(dim=(0, 2, 3)) for each in images)
    np.testing.assert_allclose(own / corrected, [found.state(c).gain for c in NAMES], rtol=1e-5)


def test_a_camera_without_a_spike_is_left_out_and_said_but_two_must_have_some():
    found = survey_streams(changed(1, np.zeros_like))
    assert f"{NAMES[1]} has no spike: left out" in found.notes
    assert [c.id for c in found.scene.cameras] == [n for n in NAMES if n != NAMES[1]]
    silent = changed(0, np.zeros_like).streams[0]
    with pytest.raises(UserError, match="expected two cameras that recorded spikes, in most ticks, found 0"):
        survey_streams(replace(SCENE, streams=(silent,) * len(NAMES)))


def test_exposures_that_differ_by_orders_of_magnitude_are_refused():
    def dimmed(spikes):
        spikes[np.arange(len(spikes)) % 100 > 0] = 0
        return spikes

    with pytest.raises(UserError, match=f"mean rates differ by less than 30 times, found .* of {NAMES[2]}, .*alike"):
        survey_streams(changed(2, dimmed))
