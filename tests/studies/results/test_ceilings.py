"""Ceilings of scores: noise of a known size in the truth is found, where things move and elsewhere."""

import shutil
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from spike4dgs.benchmark.scene.images import write_exr
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.studies.results import code_state
from spike4dgs.studies.results.plan import CEILING
from spike4dgs.studies.results.tables.ceilings import measure_ceiling

STILL, MOVING = 0.02, 0.04  # standard deviations of the noise that is added


@pytest.mark.slow  # it renders
def test_noise_of_a_known_size_in_the_truth_is_the_ceiling(tiny_data: Path, tmp_path: Path) -> None:
    shutil.copytree(tiny_data / "car-0-tiny", root := tmp_path / "car-0-tiny")
    scene = open_scene(root)
    target = scene.targets[len(scene.targets) // 2]
    truth, moving = scene.ground_truth(target), scene.moving(target)
    noise = np.random.default_rng(0).normal(0, np.where(moving, MOVING, STILL)).astype(np.float32)
    write_exr(root / f"images/{target.name}.exr", truth + noise, 0)
    write_manifest(root)
    squares = (np.clip(truth + noise, 0, 1) - np.clip(truth, 0, 1)) ** 2
    found = measure_ceiling(open_scene(root))
    assert found["error"] is None
    assert found["metrics"]["psnr"] == pytest.approx(-10 * np.log10(squares.mean()), abs=0.5)
    assert found["metrics"]["psnr_dynamic"] == pytest.approx(-10 * np.log10(squares[moving].mean()), abs=0.8)


def test_the_code_of_ceilings_and_images_has_what_measures_them(monkeypatch: pytest.MonkeyPatch) -> None:
    hashed: list[list[str]] = []

    def note(packages: list[ModuleType]) -> str:
        hashed.append([package.__name__ for package in packages])
        return "0" * 64

    monkeypatch.setattr(code_state, "sources_sha256", note)
    for row in (CEILING, "tfp+stg", "tfp+rig-flat.images"):
        code_state.code_digest(row)
    ceiling, baseline, image = hashed
    assert "spike4dgs.leaderboard.truth_check" in ceiling
    scoring = {"images", "results.tables.images", "speed_error.images"}
    assert set(image) - set(baseline) == {f"spike4dgs.studies.{name}" for name in scoring}
    assert "spike4dgs.generators" in ceiling and "spike4dgs.baselines" not in ceiling
    assert "spike4dgs.baselines" in baseline and "spike4dgs.generators" not in baseline


def test_a_scene_that_no_world_made_is_skipped(small_scene: Path) -> None:
    found = measure_ceiling(open_scene(small_scene))
    assert found["error"].startswith("skipped: ") and found["metrics"] == {}
