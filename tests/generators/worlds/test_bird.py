"""The bird's wings and tail."""

from __future__ import annotations

import numpy as np
import pytest
from built_worlds import built

from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds.parts import bird_body

BEATS = [bird_body.Beat(), bird_body.Beat(20.0, 0.9, phase=2.0)]
SPANWISE, CHORDWISE = 33, 9


def left_wing(beat, t):
    return np.split(bird_body.wing_points(beat, t), 2)[0].reshape(SPANWISE, CHORDWISE, 3)


@pytest.mark.parametrize("beat", BEATS)
def test_wings_and_tail_repeat_with_every_beat_and_are_their_own_mirror_images(beat):
    for t in np.linspace(0, 1 / beat.hz, 7):
        left, right = np.split(bird_body.wing_points(beat, t), 2)
        np.testing.assert_allclose(left * [1, -1, 1], right, atol=1e-12)
        tail = bird_body.tail_points(beat, t).reshape(21, 9, 3)
        np.testing.assert_allclose(tail * [1, -1, 1], tail[::-1], atol=1e-12)
        for points in (bird_body.wing_points, bird_body.tail_points):
            np.testing.assert_allclose(points(beat, t), points(beat, t + 3 / beat.hz), atol=1e-9)


@pytest.mark.parametrize("beat", BEATS)
def test_nothing_stretches(beat):
    """Chords and tail feathers keep their length exactly, the lines along the span within a few percent."""
    wings = np.stack([left_wing(beat, t) for t in np.linspace(0, 1 / beat.hz, 25)])
    chords = np.linalg.norm(wings[:, :, -1] - wings[:, :, 0], axis=-1)
    np.testing.assert_allclose(chords, np.broadcast_to(chords[0], chords.shape), atol=1e-12)
    spans = np.linalg.norm(np.diff(wings, axis=1), axis=-1).sum(1)  # [25, lines]
    assert (np.ptp(spans, axis=0) / spans.mean(0)).max() < 0.08
    front = np.linalg.norm(np.diff(wings[:, :, 0, 1:], axis=1), axis=-1).sum(1)
    np.testing.assert_allclose(front, bird_body.SPAN_M, rtol=1e-6)
    tails = np.stack([bird_body.tail_points(beat, t).reshape(21, 9, 3) for t in np.linspace(0, 1 / beat.hz, 25)])
    feathers = np.linalg.norm(tails[:, :, -1] - tails[:, :, 0], axis=-1)
    assert (np.ptp(feathers, axis=0) / feathers.mean(0)).max() < 0.03
    assert np.ptp(wings[:, -1, 0, 2]) > 0.2  # the tip beats
    spread = np.ptp(tails[:, :, -1, 1], axis=1)
    assert 1.1 < spread.max() / spread.min() < 2


@pytest.mark.parametrize("beat", BEATS)
def test_the_tip_lags_behind_the_root_and_the_wing_bends(beat):
    t = np.linspace(0, 1 / beat.hz, 400, endpoint=False)
    rise, pitch = np.array([beat.angles(x, np.array([0.0, 0.5, 1.0])) for x in t]).transpose(1, 0, 2)
    highest = rise.argmax(0) / 400 * 2 * np.pi
    lags = np.angle(np.exp(1j * (highest - highest[0])))
    np.testing.assert_allclose(lags, [0, beat.lag / 2, beat.lag], atol=0.02)
    assert np.ptp(rise, axis=0)[2] > np.ptp(rise, axis=0)[0] > 0.5
    assert np.ptp(pitch, axis=0)[0] == 0 and np.ptp(pitch, axis=0)[2] > 0.5


@pytest.mark.parametrize("variant", [0, 1, 2, 3])
def test_the_bird_flies_to_the_right_above_the_deck_inside_the_image(variant):
    world = built("bird", variant, 0.1)
    assert 12 <= world.notes["wing_beats_per_s"] <= 20
    assert world.notes["speed_m_s"] >= 7.5 * world.notes["length_m"]
    times = np.linspace(0, 0.1, 21)
    nose = [world.poses(t)["bird"][0, 3] for t in times]
    np.testing.assert_allclose(np.diff(nose), world.notes["speed_m_s"] * 0.005, atol=1e-12)
    assert nose[10] == pytest.approx(0, abs=1e-12)
    (camera,) = cameras(world, 200, 125, (4,))
    for t in times:
        points = world.moving_points(t)
        assert points[:, 2].min() > 0.05
        uv, z = camera.project(points)
        inside = (uv > 0).all(1) & (uv < [200, 125]).all(1) & (z > 0.4)
        assert inside.mean() > 0.97
        assert 0.2 < np.ptp(uv[:, 0]) / 200 < 0.6


def test_wings_and_tail_are_attached_to_the_body():
    world = built("bird", 0, 0.1)
    skin = world.groups["bird"][0].mesh.vertices
    for t in np.linspace(0, 0.1, 9):
        for root in (left_wing(bird_body.Beat(), t)[0, 0], bird_body.tail_points(bird_body.Beat(), t)[0]):
            assert np.linalg.norm(skin - root, axis=1).min() < 0.03
