import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from toy_world import GAIN, RATE_HZ, ToyWorld, few_views

from spike4dgs.baselines.starts import colmap as module
from spike4dgs.baselines.starts.colmap import ColmapSettings, colmap
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.pose_error import pose_errors
from spike4dgs.benchmark.scene.calibration import Recordings
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.starts.rig import RigSettings, rig
from spike4dgs.method.starts.structure_from_motion import Mapping, clip_means, map_views

WORLD = ToyWorld(width=120, height=76, n_ticks=96, travel=0.1, seed=1, spread=0.05)  # of many intrinsics


@pytest.fixture(scope="module")
def mapping() -> Mapping:
    return map_views(WORLD.training.cameras, clip_means(WORLD.training), 0)


def test_means_are_the_radiance_of_what_stands_still() -> None:
    means = clip_means(WORLD.training)
    image, _, board = WORLD.trace(WORLD.training.cameras[2], 0.5)
    background = ~cv2.dilate(board.astype(np.uint8), np.ones((15, 15), np.uint8)).astype(bool)
    assert means.shape == (8, 76, 120) and means.dtype == np.float32
    assert np.abs(means[2] - image)[background].max() < 0.02  # less than one spike in 96 ticks, at 0.6 spikes a tick


def test_poses_of_all_views_are_found_and_each_keeps_its_intrinsics(mapping: Mapping) -> None:
    assert [c.id for c in mapping.cameras] == [c.id for c in WORLD.training.cameras]
    summary = pose_errors(mapping.cameras, WORLD.training.cameras).summary()
    assert summary["rotation_max_deg"] < 0.5 and summary["translation_of_array"] < 0.05, summary
    assert summary["rra_5"] == summary["rta_5"] == 1
    for a, true in zip(mapping.cameras, WORLD.training.cameras, strict=True):
        assert (a.fx, a.fy, a.cx, a.cy) == pytest.approx((true.fx, true.fy, true.cx, true.cy))
    assert len({camera.fx for camera in mapping.cameras}) > 2


def test_points_lie_on_the_surfaces_in_the_scenes_frame_with_their_gray_values(mapping: Mapping) -> None:
    assert len(mapping.points) == len(mapping.values) >= 50
    uv, z = WORLD.held_out.project(mapping.points)
    inside = (uv >= 0).all(axis=1) & (uv < [120, 76]).all(axis=1) & (z > 0)
    u, v = uv[inside].astype(int).T
    image, depth, _ = WORLD.trace(WORLD.held_out, 0.5)
    assert inside.mean() > 0.7
    assert np.median(np.abs(z[inside] / depth[v, u] - 1)) < 0.03
    assert np.corrcoef(mapping.values[inside], image[v, u])[0, 1] > 0.7


def test_the_same_seed_gives_the_same_poses_and_nothing_stays_behind(
    mapping: Mapping, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    again = map_views(WORLD.training.cameras, clip_means(WORLD.training), 0)
    for a, b in zip(again.cameras, mapping.cameras, strict=True):
        assert np.array_equal(a.w2c, b.w2c)
    assert not os.listdir(tmp_path)
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""


def test_a_failure_says_how_many_views_are_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    flat = replace(WORLD.training, streams=tuple(replace(s, packed=0 * s.packed) for s in WORLD.training.streams))
    with pytest.raises(UserError, match="COLMAP on toy: expected all 8 views registered, found 0 of 8"):
        colmap(flat, 0)
    few = Mapping(WORLD.training.cameras[:3], np.zeros((200, 3)), np.zeros(200, np.float32))
    monkeypatch.setattr(module, "map_views", lambda *a, **k: few)
    with pytest.raises(UserError, match="found 3 of 8"):
        colmap(WORLD.training, 0)


def test_points_are_those_of_a_plane_sweep_with_the_estimated_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many as rows with given poses begin with, however few features the views have in common."""
    scene = few_views(WORLD.training, 0, 2, 5, 7)  # as each is compared with all others
    moved = tuple(replace(c, t=c.t + [0.0, 0.0, 0.01]) for c in scene.cameras)
    found = Mapping(moved, np.ones((3, 3)), np.ones(3, np.float32))
    monkeypatch.setattr(module, "map_views", lambda *a, **k: found)
    start, given = colmap(scene, 0), rig(replace(scene, cameras=moved))
    assert start.cameras == moved
    np.testing.assert_array_equal(start.points, given.points)


class UnevenWorld(ToyWorld):
    """The world seen by sensors whose pixels' gains spread by 8 %: a pattern that is fixed in every view."""

    def gains(self, camera: Camera) -> NDArray[np.float64]:
        rng = np.random.default_rng([7, int(camera.id[-2:])])
        return 1 + 0.08 * rng.standard_normal((camera.height, camera.width)).clip(-3, 3)

    def trace(self, camera: Camera, t: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        image, depth, board = super().trace(camera, t)
        return image * self.gains(camera), depth, board

    def recordings(self, camera: Camera) -> Recordings:
        """500 ticks of a flat field of 0.7 and of darkness."""
        gains = self.gains(camera)
        rate, start = 0.7 * GAIN * gains, np.random.default_rng(8).random(gains.shape)
        ticks = np.floor(start + rate * np.arange(501)[:, None, None])
        flat = pack(np.diff(ticks, axis=0).astype(bool))
        streams = (SpikeStream(p, camera.width, camera.height, RATE_HZ) for p in (flat, np.zeros_like(flat)))
        return Recordings(*streams, 0.7)


def test_features_and_points_are_those_of_images_without_the_pixels_pattern(monkeypatch: pytest.MonkeyPatch) -> None:
    """The points come from a plane sweep at the estimated poses of cameras that are alike."""
    size = {"width": 120, "height": 76, "n_ticks": 96, "travel": 0.0, "seed": 1, "views": (0, 1, 3, 4, 6)}
    world, even = (kind(**size) for kind in (UnevenWorld, ToyWorld))
    scene = replace(world.training, recordings=tuple(world.recordings(c) for c in world.training.cameras))
    seen: list[NDArray[np.float32]] = []

    def watched(cameras: Sequence[Camera], images: NDArray[np.float32], seed: int, own: ColmapSettings) -> Mapping:
        seen.append(images)
        return map_views(cameras, images, seed, own)

    monkeypatch.setattr(module, "map_views", watched)
    start = colmap(scene, 0, ColmapSettings(flat_field=True))
    truth = np.stack([even.trace(camera, 0.5)[0] for camera in scene.cameras])
    corrected, plain = (np.sqrt(np.mean((p - truth) ** 2)) for p in (seen[0], clip_means(scene)))
    assert corrected < 0.012 < 0.03 < plain
    summary = pose_errors(start.cameras, scene.cameras).summary()
    assert 0 < summary["rotation_max_deg"] < 0.5 and summary["translation_of_array"] < 0.05, summary
    assert all(a.fx == pytest.approx(true.fx) for a, true in zip(start.cameras, scene.cameras, strict=True))
    given = rig(scene, RigSettings(flat_field=True))
    assert len(start.points) > 0.8 * len(given.points) > 500
    assert not np.array_equal(start.points[:100], given.points[:100])
