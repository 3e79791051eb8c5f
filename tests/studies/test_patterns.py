import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import find_methods, training_for
from spike4dgs.benchmark.scene.calibration import Calibration, Recordings
from spike4dgs.benchmark.scene.scene import TrainingScene, open_scene
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.cli import main
from spike4dgs.studies import patterns as pattern_report
from spike4dgs.studies.patterns import pattern_errors

METHODS = find_methods()


def test_errors_are_of_gains_of_mean_one_and_in_part_what_cameras_share() -> None:
    rng = np.random.default_rng(0)
    true = 1 + 0.05 * rng.normal(size=(4, 30, 40))
    true /= true.mean(axis=(1, 2), keepdims=True)
    shared = 0.02 * rng.normal(size=(30, 40))
    own = 0.01 * rng.choice([-1.0, 1.0], size=(2, 30, 40))
    error = shared - shared.mean() + np.stack([own[0], -own[0], own[1], -own[1]])
    known = [Calibration((3 * g).astype(np.float32), np.full((30, 40), 0.004, np.float32), 0.6) for g in true]
    rows = pattern_errors(2 * (true + error), np.full((4, 30, 40), 0.0045), known)
    for camera, row in enumerate(rows):
        off = (true + error)[camera] / (true + error)[camera].mean() - true[camera]
        assert row["gain_error"] == pytest.approx(100 * np.sqrt((off**2).mean()), rel=1e-4)
        assert row["gain_error_apart"] == pytest.approx(1.0, rel=1e-2)
        assert row["gain_error"] == pytest.approx(np.hypot(2.0, 1.0), rel=0.05)
        assert row["gain_spread"] == pytest.approx(100 * true[camera].std(), rel=1e-4)
        assert row["dark_error"] == pytest.approx(0.5, rel=1e-3)


def test_the_recipe_is_the_calibrated_one_without_calibrations() -> None:
    own, calibrated = METHODS["spike4dgs-x+self-calibrated"], METHODS["spike4dgs-x"]
    assert calibrated.given == ("poses", "flat-field") and own.given == ("poses",)
    a, b = (m.params["settings"] for m in (own, calibrated))
    assert not a["images"]["flat_field"] and not a["initialization"]["flat_field"]
    differs = {
        f"{part}.{name}"
        for part in ("image_maker", "motion", "trainer", "density")
        for name in b[part]
        if a[part][name] != b[part][name]
    }
    assert differs == {"motion.coherence", "trainer.coarse_steps"}


def with_recordings(scene: Path) -> TrainingScene:
    """The training views, each with recordings of 0.7 of white and of the dark."""
    training = open_scene(scene).training
    rng = np.random.default_rng(3)

    def recording(rate: float, n_ticks: int) -> SpikeStream:
        height, width = training.cameras[0].height, training.cameras[0].width
        return SpikeStream(pack(rng.random((n_ticks, height, width)) < rate), width, height, training.rate_hz)

    found = [Recordings(recording(0.4, 200), recording(0.01, 400), 0.7) for _ in training.cameras]
    return replace(training, recordings=tuple(found))


@pytest.mark.parametrize("recorded", [False, True])
def test_command_writes_maps_and_their_errors(recorded, small_scene: Path, tmp_path, capsys, monkeypatch) -> None:
    scene = with_recordings(small_scene) if recorded else open_scene(small_scene).training
    (out := tmp_path / scene.id).mkdir()
    (out / "errors.json").touch()  # of another fit
    (tmp_path / "mine.npz").touch()
    monkeypatch.setattr(pattern_report, "open_scene", lambda *_: SimpleNamespace(training=scene))
    assert main(["patterns", str(small_scene), "--budget", "0.01", "--out", str(tmp_path)]) == 0
    gain, dark = [], []
    for camera in scene.cameras:
        with np.load(out / f"{camera.id}.npz") as maps:
            gain.append(maps["gain"].astype(np.float64))
            dark.append(maps["dark"].astype(np.float64))
    assert np.stack(gain).shape == (len(scene.cameras), scene.cameras[0].height, scene.cameras[0].width)
    assert np.stack(gain).mean(axis=(1, 2)) == pytest.approx(1, abs=1e-5)
    assert (out / "gain.png").read_bytes()[:4] == b"\x89PNG"
    assert (out / "errors.json").exists() == recorded and (tmp_path / "mine.npz").exists()
    if recorded:
        rows = json.loads((out / "errors.json").read_text())
        expected = pattern_errors(np.stack(gain), np.stack(dark), scene.calibrations)
        assert list(rows) == [camera.id for camera in scene.cameras]
        for row, right in zip(rows.values(), expected, strict=True):
            assert row == pytest.approx(right, rel=1e-4)
    assert str(out) in capsys.readouterr().out.replace("\n", "")


def test_a_place_that_cannot_be_written_is_told_before_the_fit(small_scene: Path, monkeypatch) -> None:
    monkeypatch.setattr(pattern_report, "METHODS", {})
    with pytest.raises(UserError, match="/proc/nowhere/pattern-0: expected"):
        pattern_report.patterns(small_scene, out=Path("/proc/nowhere"))


def test_the_fit_gets_no_recordings(small_scene: Path) -> None:
    scene = with_recordings(small_scene)
    assert scene.calibrations is not None
    assert training_for(METHODS["spike4dgs-x+self-calibrated"], scene).calibrations is None
