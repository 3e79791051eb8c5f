from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.images import gray
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.generators import truth as renderings
from spike4dgs.generators.profiles import RATE_HZ, SPLIT_PROFILES, Job
from spike4dgs.generators.render_tasks import RenderTargets, cameras_of, renderer_of
from spike4dgs.generators.truth import second_renderings, second_truth
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


def test_a_second_rendering_with_a_pixel_that_is_no_number_is_refused(
    tiny_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = open_scene(tiny_data / "car-0-tiny")
    image = scene.ground_truth(scene.targets[0])
    image[3, 5] = np.nan
    monkeypatch.setattr(renderings, "second_truth", lambda *_: lambda _: image)
    with pytest.raises(UserError, match=r"car-0-tiny.*finite second rendering, found 1 pixels that are not"):
        second_renderings(scene)


@pytest.mark.slow
def test_a_second_truth_with_the_seed_of_the_first_equals_it() -> None:
    """So the two differ in random numbers alone, where views share maps of soft light."""
    profile = replace(SPLIT_PROFILES["tiny"], views=(2, 4), target_spp=16)
    job = Job("turntable", 0, 0, "tiny", profile, 0.004)
    static = renderer_of(job, cameras_of(job), truth=True).static
    tick = next(t for t in job.target_ticks if t not in job.sparse_ticks)
    (truth,) = RenderTargets(job, static)([tick])
    again = second_truth(job, truth.view, job.render_seed + 1)(tick / RATE_HZ)
    np.testing.assert_allclose(gray(truth.rgb), again, rtol=1e-5, atol=1e-6)
    assert np.abs(second_truth(job, truth.view, 77)(tick / RATE_HZ) - again).mean() > 1e-4
