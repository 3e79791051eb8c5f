from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.generators.second_renderings import second_renderings
from spike4dgs.leaderboard.truth_check import noise_ceiling_db, noise_share


def test_scenes_that_no_world_made_have_none(small_scene: Path) -> None:
    assert second_renderings(open_scene(small_scene)) is None


@pytest.mark.slow
def test_second_renderings_show_the_truths_noise(tiny_data: Path) -> None:
    scene = open_scene(tiny_data / "car-0-tiny")
    found = second_renderings(scene)
    assert found is not None
    target, first, second = found
    truth = scene.ground_truth(target)
    ceiling = noise_ceiling_db(truth, first, second)
    assert ceiling is not None and 38 < ceiling < 60
    between = -10 * np.log10(np.mean((np.clip(first, 0, 1) - np.clip(second, 0, 1)) ** 2))
    assert between < ceiling, "each of them has noise of its own"
    share, error = noise_share(truth, truth, first, second)
    assert share == pytest.approx(1, abs=0.02) and error is not None and error < 0.02
