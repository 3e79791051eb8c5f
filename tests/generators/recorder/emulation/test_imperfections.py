"""Captures that are worse on purpose: what a seed decides, and what reaches the recording."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from recorder_rig import calibrated_scene

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.pose_error import angle_deg
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.spikes.folder import open_stream_folder
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.cli import main
from spike4dgs.generators.recorder.emulation.array import scene_profile
from spike4dgs.generators.recorder.emulation.imperfections import Imperfections, draw, with_wrong_calibrations
from spike4dgs.generators.sensor import calibration as calibration


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return calibrated_scene(tmp_path_factory.mktemp("source") / "pattern")


def record(*arguments):
    return main(["record", *map(str, arguments)])


def streams_of(folder):
    found = open_scene(folder, allow_gaps=True)
    return {name: np.asarray(found.stream(name).packed) for name in found.cameras}


def test_the_seed_decides_and_the_primary_keeps_time(scene):
    profile = scene_profile(open_scene(scene), layout="tagged-rows")
    worse = Imperfections(3, 20, 0.01, 9, 0.02, 1)
    first, again, other = (draw(worse, profile, 1000, seed) for seed in (0, 0, 1))
    for name, c in first.items():
        assert c.clock == again[name].clock and c.dropped == again[name].dropped and c.gain == again[name].gain
        assert c.gain != other[name].gain and abs(c.gain - 1) <= 0.02
        assert abs(c.clock.offset_ticks) <= 3 and abs(c.clock.drift_ppm) <= 20
        assert [len(p) for p in (c.bad.dead, c.bad.hot, c.bad.flickering)] == [3, 3, 3]
        assert angle_deg(c.turn) == pytest.approx(1)
        assert 0 not in c.dropped and len(c.dropped) < 40
    assert (first["cam_00"].clock.offset_ticks, first["cam_00"].clock.drift_ppm) == (0, 0)
    assert len({c.gain for c in first.values()}) == 4


def test_an_array_without_imperfections_gives_the_same_bytes(scene, tmp_path):
    zero = ("--worse.offset-ticks", 0, "--worse.dropped", 0, "--worse.gain", 0, "--seed", 5)
    assert record("--emulate", scene, "--out", tmp_path / "x") == 0
    assert record("--emulate", scene, "--out", tmp_path / "y", *zero) == 0
    a, b = streams_of(tmp_path / "x"), streams_of(tmp_path / "y")
    assert all((a[name] == b[name]).all() for name in a)
    assert open_scene(tmp_path / "y").targets


def test_a_worse_clip_shows_all_of_it_and_none_of_the_truth(scene, tmp_path, capsys):
    worse = "--worse.offset-ticks 3 --worse.drift-ppm 20 --worse.dropped 0.05 --worse.bad-pixels 9 --worse.gain 0.02"
    options = (*worse.split(), "--worse.pose-deg", "1", "--seed", "4", "--worse-truth", tmp_path / "truth.json")
    assert record("--emulate", scene, "--out", tmp_path / "x", *options) == 3
    found, source = open_scene(tmp_path / "x", allow_gaps=True), open_scene(scene)
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert truth["seed"] == 4 and truth["worse"]["drift_ppm"] == 20
    assert "truth.json" in capsys.readouterr().out
    for name, done in truth["cameras"].items():
        gaps = [g for g in found.gaps if g.camera == name]
        missing = [t for g in gaps for t in range(g.first_tick, g.stop_tick)]
        assert missing == done["dropped_ticks"]
        kept = present(gaps, found.n_ticks)
        spikes = found.stream(name).window(0, found.n_ticks)[kept]
        assert all(not spikes[:, y, x].any() for y, x in done["dead"])
        own = found.cameras[name], source.cameras[name]
        np.testing.assert_allclose(own[0].center, own[1].center, atol=1e-9)
        assert angle_deg(own[0].R @ own[1].R.T) == pytest.approx(1)
    assert found.gaps and not found.targets
    folders = {name.partition("/")[0] for name in found.manifest.files}
    assert not folders & {"images", "masks", "geometry", "truth", "calibration"}


def test_ticks_are_dropped_for_as_long_as_a_clip_lasts(scene, tmp_path, capsys):
    drop = ("--emulate", scene, "--worse.dropped", "0.1", "--worse-truth", tmp_path / "t.json")
    assert record(*drop, "--out", tmp_path / "x", "--seconds", 240 / 20000) == 3
    for done in json.loads((tmp_path / "t.json").read_text())["cameras"].values():
        # A loop of the scene is 80 ticks: the first is what it was for a clip of that length.
        assert sum(t < 80 for t in done["dropped_ticks"]) < sum(t >= 80 for t in done["dropped_ticks"])
    lost = {t for g in open_scene(tmp_path / "x", allow_gaps=True).gaps for t in range(g.first_tick, g.stop_tick)}
    assert min(lost) < 80 and max(lost) >= 160
    profile = scene_profile(open_scene(scene), layout="tagged-rows")
    short, long = (draw(Imperfections(dropped=0.1), profile, n, 0) for n in (80, 240))
    assert all(long[c].dropped[: len(short[c].dropped)] == short[c].dropped for c in short)
    assert record(*drop, "--out", tmp_path / "y", "--seconds", 1e6) == 2
    assert "--seconds: expected 1 to 10000000 ticks with --worse.dropped" in capsys.readouterr().err


def test_light_and_darkness_show_the_same_pixels_and_gains(scene, tmp_path):
    worse = ("--worse.bad-pixels", 12, "--worse.gain", 0.1, "--worse.dropped", 0.01, "--seed", 2)
    truths = []
    for mode in ("flat", "dark"):
        file = tmp_path / f"{mode}.json"
        out = ("--out", tmp_path / mode, "--worse-truth", file)
        assert record("--emulate", scene, "--mode", mode, *out, *worse) == 0, "uniform light is recorded without losses"
        truths.append(json.loads(file.read_text())["cameras"])
    flat, dark = (open_stream_folder(tmp_path / mode) for mode in ("flat", "dark"))
    source = open_scene(scene)
    for name, done in truths[0].items():
        assert [done[k] for k in ("dead", "hot", "gain")] == [truths[1][name][k] for k in ("dead", "hot", "gain")]
        light = flat[name].counts(0, flat[name].n_ticks).astype(float)
        assert all(light[y, x] == 0 for y, x in done["dead"])
        night = dark[name].counts(0, dark[name].n_ticks) / dark[name].n_ticks
        assert all(night[y, x] > 0.09 for y, x in done["hot"])
        before = source.recordings(name).flat.counts(0, calibration.FLAT_TICKS)
        assert np.median(light / before) == pytest.approx(done["gain"], abs=0.005)
    light = ("--flat", tmp_path / "flat", "--dark", tmp_path / "dark", "--flat-radiance", 0.7)
    assert record("--emulate", scene, "--out", tmp_path / "clip", *light, *worse) in (0, 3)
    clip = open_scene(tmp_path / "clip", allow_gaps=True)
    np.testing.assert_array_equal(clip.recordings("cam_01").flat.packed, flat["cam_01"].packed)


def test_a_share_of_the_lens_is_missing_from_the_calibration_alone(scene):
    profile = scene_profile(open_scene(scene), layout="tagged-rows")
    lens = (-0.2, 0.04, 0.001, 0.0, 0.0)
    cameras = tuple(replace(c, calibration=replace(c.calibration, distortion=lens)) for c in profile.cameras)
    curved = replace(profile, cameras=cameras)
    for share, left in ((0.0, lens), (0.25, (-0.15, 0.03, 0.00075, 0.0, 0.0)), (1.0, ())):
        worse = with_wrong_calibrations(curved, draw(Imperfections(lens=share), curved, 100, 0))
        for before, after in zip(curved.cameras, worse.cameras, strict=True):
            assert after.calibration.distortion == pytest.approx(left)
            np.testing.assert_array_equal(after.calibration.R, before.calibration.R)


def test_options_that_do_not_fit_are_refused(scene, tmp_path, capsys):
    out = ("--out", tmp_path / "x")
    for arguments, message in (
        (("rig.toml", "--worse.gain", 0.1), "--emulate SCENE: no real array is made worse"),
        (("--emulate", scene, "--worse.gain", 0.7), "--worse.gain: expected a number from 0 to 0.5"),
        (("--emulate", scene, "--worse-truth", tmp_path / "t.json"), "imperfections"),
        (("--emulate", scene, "--worse.gain", 0.1, "--worse-truth", tmp_path / "x" / "t.json"), "a file outside"),
        (("--emulate", scene, "--worse.bad-pixels", 5000), "at most 960"),
    ):
        assert record(*arguments, *out) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
    with pytest.raises(UserError, match="frames with a counter"):
        draw(Imperfections(dropped=0.1), scene_profile(open_scene(scene)), 100, 0)
