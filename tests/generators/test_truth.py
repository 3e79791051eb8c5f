"""Ground truth on disk, its audit, and its noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.images import gray
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.cli.make_dataset import physics_of
from spike4dgs.generators import truth as renderings
from spike4dgs.generators.make_dataset import SceneSettings
from spike4dgs.generators.profiles import RATE_HZ, SPLIT_PROFILES, Job, SplitSampling
from spike4dgs.generators.render_tasks import RenderTargets, cameras_of, renderer_of
from spike4dgs.generators.rendering.keyframes import finite
from spike4dgs.generators.truth import _total, errors, lit_pairs, moving_region, second_renderings, second_truth
from spike4dgs.leaderboard.truth_check import noise_ceiling_db, noise_share


def test_moving_region_has_the_object_and_its_moving_shadow_only():
    background = np.full((30, 40), 0.5, np.float32)
    mask = np.zeros((30, 40), bool)
    mask[10:15, 10:15] = True
    image, varies = background.copy(), np.zeros((30, 40), bool)
    image[20:25, 5:20] = 0.3
    varies[:, :12] = True  # the right part of the shadow does not move
    image[2, 2] = 0.9  # a speck of noise
    expected = np.zeros((30, 40), bool)
    expected[8:17, 8:17] = True
    expected[20:25, 5:12] = True
    assert np.array_equal(moving_region(mask, image, background, varies), expected)


def test_audit_errors_against_closed_forms():
    truth = np.full((10, 10), 0.5, np.float32)
    image, moving = truth.copy(), np.zeros((10, 10), bool)
    image[:5] += 0.05
    moving[:1] = True
    found = errors(image, truth, moving)
    assert found["psnr_db"] == pytest.approx(-10 * np.log10(0.05**2 / 2), abs=1e-3)
    assert found["psnr_db_moving"] == pytest.approx(-20 * np.log10(0.05), abs=1e-3)
    assert found["mean_percent"] == pytest.approx(5, abs=1e-3)
    assert found["mean_percent_moving"] == pytest.approx(10, abs=1e-3)
    assert found["mean_absolute"] == pytest.approx(0.025, abs=1e-4)
    assert "psnr_db_moving" not in errors(image, truth, np.zeros((10, 10), bool))


def test_totals_are_over_the_images_with_a_value():
    rows = [{"tick": 1, "psnr_db": 40.0}, {"tick": 2, "psnr_db": 30.0, "psnr_db_moving": 20.0}]
    assert _total(rows) == {"psnr_db": 35.0, "psnr_db_moving": 20.0}


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


def test_any_target_with_light_is_rendered_again(tiny_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A truth that is copied into all images but the middle one does not stay hidden."""
    scene = open_scene(tiny_data / "car-0-tiny")
    image = scene.ground_truth(scene.targets[0])
    monkeypatch.setattr(renderings, "second_truth", lambda *_: lambda _: image)
    drawn = {found[0] for _ in range(60) if (found := second_renderings(scene))}
    assert len(drawn) > 1 and drawn <= set(scene.targets)
    monkeypatch.setattr(Job, "light_at", lambda _, tick: float(tick == scene.targets[-1].tick))
    assert second_renderings(scene, lambda targets: targets[0])[0] == scene.targets[-1]
    monkeypatch.setattr(Job, "light_at", lambda *_: 0.0)
    assert second_renderings(scene) is None


def test_a_second_rendering_with_a_pixel_that_is_no_number_is_refused(
    tiny_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = open_scene(tiny_data / "car-0-tiny")
    image = scene.ground_truth(scene.targets[0])
    image[3, 5] = np.nan
    monkeypatch.setattr(renderings, "second_truth", lambda *_: lambda _: image)
    with pytest.raises(UserError, match=r"car-0-tiny.*finite second rendering, found 1 pixels that are not"):
        second_renderings(scene)


def test_a_pixel_that_is_no_number_once_is_rendered_again(capsys: pytest.CaptureFixture[str]) -> None:
    image, torn = np.ones((4, 5), np.float32), np.ones((4, 5), np.float32)
    torn[2, 3] = np.nan
    for good, bad in ((image, torn), ({"given0": np.ones(3, bool), "values0": image}, {"values0": torn})):
        made = [good, bad]
        assert finite(lambda _, made=made: made.pop(), 0.5, "car-0, key frame 28") is good
        assert capsys.readouterr().err == "car-0, key frame 28: a pixel is no number; rendered again\n"
        assert finite(lambda _, good=good: good, 0.5, "car-0") is good and not capsys.readouterr().err
    assert finite(lambda _: torn, 0.5, "the world's fault") is torn


@pytest.mark.slow
def test_noise_is_measured_where_there_is_light() -> None:
    """An LED that is dark half of the time: its truth is divided by the light."""
    settings = SceneSettings("small", physics=physics_of("flicker=1 flicker-duty=0.5"))
    job = settings.job("car")
    pairs = lit_pairs(job)
    assert pairs and all(job.light_at(t) > 0 for pair in pairs for t in pair)
    assert any(job.light_at(t) == 0 for t in job.target_ticks)
    assert len(lit_pairs(SceneSettings("small").job("car"))) == 3


def test_a_second_truth_with_the_seed_of_the_first_equals_it() -> None:
    """So the two differ in random numbers alone, where views share maps of soft light."""
    soft = SplitSampling(16, 8, 0.5, 4, 0.0004)
    profile = replace(
        SPLIT_PROFILES["tiny"], views=(2, 4), width=32, height=20, background_spp=16, target_spp=16, target_soft=soft
    )
    job = Job("turntable", 0, 0, "tiny", profile, 0.004)
    static = renderer_of(job, cameras_of(job), truth=True).static
    tick = next(t for t in job.target_ticks if t not in job.sparse_ticks)
    (truth,) = RenderTargets(job, static)([tick])
    again = second_truth(job, truth.view, job.render_seed + 1)(tick / RATE_HZ)
    np.testing.assert_allclose(gray(truth.rgb), again, rtol=1e-5, atol=1e-6)
