"""Rows of other sensors: frames at their times, EDI, exposures by rendering, and no spike in any of them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sensor_recordings import keys_of, record
from toy_fits import SUPERVISIONS, silent
from toy_world import RATE_HZ, ToyWorld

from spike4dgs.baselines.exposure import Exposure, ExposureSettings
from spike4dgs.baselines.images.frames import edi, edi_images, exposure_mean, frame_images
from spike4dgs.baselines.recipes import METHODS, PARTS, SENSORS
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import Budget, FitRequest, Recipe, training_for
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.generators.other_sensors import exposures
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.gaussians.density import DensitySettings
from spike4dgs.method.gaussians.parameters import from_points
from spike4dgs.method.images.recorded import Recorded
from spike4dgs.method.motion.base import Extent
from spike4dgs.method.motion.table import Static
from spike4dgs.method.schedule import TrainerSettings
from spike4dgs.method.splat import Views
from spike4dgs.method.starts.base import Start
from spike4dgs.method.starts.clip import ImageClip
from spike4dgs.method.starts.rig import rig
from spike4dgs.method.supervision.base import Sample
from spike4dgs.method.torch_state import seeded
from spike4dgs.method.trainer import Trainer
from spike4dgs.method.training_views.training_images import TrainingImages

WORLD = ToyWorld(width=48, height=30, n_ticks=520, travel=0.3, views=(0, 1, 2, 5, 7))  # two frames
QUICK = FitRequest(Budget(0.004), progress=silent)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> TrainingScene:
    return record(WORLD, tmp_path_factory.mktemp("fine"), threshold=0.05)


def truth(camera: int, ticks: Any) -> np.ndarray:
    return np.stack([WORLD.trace(WORLD.cameras[camera], t / WORLD.n_ticks)[0] for t in ticks])


def test_frames_are_those_of_the_files_in_the_middle_of_their_exposures(scene: TrainingScene) -> None:
    found = frame_images(scene)
    assert found.ticks == (83, 333 + 83) and found.exposure_ticks == 167
    keys, ticks = keys_of(WORLD, scene.cameras[2])
    expected = [image for _, image in exposures(keys, ticks, WORLD.n_ticks, int(RATE_HZ))]
    np.testing.assert_allclose(found.images[:, 2], expected, atol=0.005)  # of 8 bits
    later = replace(scene.frames("cam_01"), ticks=(1, 333))
    with pytest.raises(UserError, match="frames at the times of cam_00, found others at cam_01"):
        frame_images(replace(scene, found_frames={**scene.found_frames, "cam_01": later}))
    with pytest.raises(UserError, match="frames of a conventional camera at cam_00"):
        frame_images(WORLD.training)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 4), st.integers(0, 30), st.integers(0, 2**31))
def test_the_mean_over_an_exposure_is_that_of_fine_samples(size: int, count: int, seed: int) -> None:
    """The slow twin adds up a thousand instants of the step function that the events describe."""
    rng = np.random.default_rng(seed)
    pixels, changes = rng.integers(0, size, count), rng.choice([-0.2, 0.2], count)
    times = np.sort(rng.integers(0, 1000, count)) / 1000
    level, total = np.zeros(size), np.zeros(size)
    for k in range(1000):
        now = np.flatnonzero(times == k / 1000)
        np.add.at(level, pixels[now], changes[now])
        total += np.exp(level)
    np.testing.assert_allclose(exposure_mean(pixels, changes, times, size), total / 1000, rtol=1e-9)


def test_edi_finds_the_instants_of_a_blurred_frame(scene: TrainingScene) -> None:
    """Within an exposure, between exposures and beyond them it is right to about the threshold; the frame is not."""
    camera, ticks = 1, [5, 40, 83, 150, 250, 333, 416, 510]
    found = edi(scene.frames("cam_01"), scene.events("cam_01"), ticks)
    expected = truth(camera, ticks)
    error = np.abs(found - expected)
    frame = frame_images(scene).images[0, camera]
    assert np.quantile(error, 0.99) < 0.05 < np.quantile(np.abs(frame - expected[[0, 3]]), 0.99)
    assert error.mean() < 0.006


def test_the_mean_of_edis_instants_is_the_frame(scene: TrainingScene) -> None:
    """That is what its formula says; the middles of ticks stand for the exposure."""
    frame = frame_images(scene).images[1, 0]
    instants = edi(scene.frames("cam_00"), scene.events("cam_00"), list(range(333, 333 + 167)))
    np.testing.assert_allclose(instants.mean(axis=0), frame, atol=2e-3)


def test_edi_gives_a_still_pixel_the_frames_value(scene: TrainingScene) -> None:
    found, frames = edi_images(scene, (10, 300)), frame_images(scene).images
    for c, camera in enumerate(scene.cameras):
        events = scene.events(camera.id).events
        still = np.ones((WORLD.height, WORLD.width), bool)
        still[events.y, events.x] = False
        assert still.any()
        np.testing.assert_allclose(found.images[0, c][still], frames[0, c][still], rtol=1e-6)


def test_the_mean_of_rendered_instants_is_the_generators_frame() -> None:
    """A loss of exposures is about zero at the true motion, where that of an instant is not."""
    keys, ticks = keys_of(WORLD, WORLD.cameras[0])
    _, (_, blurred) = exposures(keys, ticks, WORLD.n_ticks, int(RATE_HZ))
    frame = torch.from_numpy(blurred.astype(np.float64))[None]
    times: list[float] = []

    def render(t: float) -> torch.Tensor:
        times.append(t)
        return torch.from_numpy(WORLD.trace(WORLD.cameras[0], t)[0])[None]

    sample = Sample((333 + 83) / WORLD.n_ticks, 333 + 83, (0,), frame, 0, exposure_ticks=167)
    losses = {}
    for n in (1, 5, 40):
        loss = Exposure(ExposureSettings(instants=n, ssim_weight=0.0), WORLD.training)
        losses[n] = float(loss(render, sample))
    assert losses[40] < 0.002 and losses[40] < losses[5] / 2 < losses[1] / 6
    at = np.array(times[1:6]) * WORLD.n_ticks
    np.testing.assert_allclose(at, 333 + 167 * np.array([0.1, 0.3, 0.5, 0.7, 0.9]))
    times.clear()
    Exposure(ExposureSettings(), WORLD.training)(render, replace(sample, exposure_ticks=0))
    assert times == [sample.t]


def test_a_scene_at_rest_is_densified_by_exposures_as_by_instants() -> None:
    cameras = WORLD.cameras[:3]
    frames = torch.from_numpy(np.stack([WORLD.trace(c, 0.5)[0] for c in cameras]).astype(np.float32))[None]
    images = TrainingImages(Views.from_cameras(cameras), (260,), frames, WORLD.n_ticks, exposure_ticks=167)
    means = []
    for supervision in ("pixel", "exposure"):
        loss = SUPERVISIONS[supervision](SUPERVISIONS[supervision].defaults, WORLD.training)
        gaussians = from_points(*WORLD.surfaces(cameras[:1], 0.01), opacity=0.5)
        settings, density = TrainerSettings(coarse_steps=10, fine_steps=0), DensitySettings()
        motion = Static(Extent(-torch.ones(3), torch.ones(3), 2.0, 520, 48), Static.defaults, seeded(0, -1))
        trainer = Trainer(images, gaussians, motion, loss, settings, density, scale=2.0, seed=0)
        trainer.train_step()
        means.append(trainer.statistics.mean())
    assert (means[0] > 0).float().mean() > 0.9
    torch.testing.assert_close(means[1], means[0], rtol=1e-3, atol=1e-3 * float(means[0].mean()))


def test_first_points_of_images_lie_on_surfaces_as_often_as_those_of_spikes(scene: TrainingScene) -> None:
    def share(start: Start) -> float:
        off = WORLD.depth_errors(start.points)
        assert len(off) > 500
        return float((off < 0.05).mean())

    of_spikes = share(rig(scene))
    for recorded in (edi_images(scene, tuple(range(10, 520, 10))), frame_images(scene)):
        assert share(rig(scene, recorded=recorded)) > of_spikes - 0.05


def test_windows_of_images() -> None:
    images = np.arange(6, dtype=np.float32)[:, None, None, None] * np.ones((6, 1, 30, 48), np.float32)
    clip = ImageClip(replace(WORLD.training, cameras=WORLD.cameras[:1]), Recorded((1, 9, 41, 42, 43, 200), images), 40)
    assert len(clip) == 3
    assert [float(clip.mean(k).mean()) for k in range(3)] == [0.5, 3.0, 5.0]
    assert float(clip.mean().mean()) == pytest.approx(np.mean([0.5, 3.0, 5.0]))
    assert clip.moving()[0].all() and not clip.moving(slice(0, 1))[0].any()


def test_a_recipe_is_given_what_it_takes() -> None:
    given = {recipe.name: METHODS[recipe.name].given for recipe in SENSORS}  # type: ignore[attr-defined]
    frames, events = ("poses", "frames"), ("poses", "frames", "events")
    of_frames, of_events = ("rgb+stg", "rgb+4dgs", "rgb-deblur+stg"), ("edi+stg", "edi+4dgs")
    assert given == dict.fromkeys(of_frames, frames) | dict.fromkeys(of_events, events)
    for changed in ({"initialization": "msdi"}, {"supervision": "spss"}, {"settings": {"images.flat_field": True}}):
        with pytest.raises(UserError, match="recipe edi.stg: expected parts that take nothing of spikes"):
            RecipeMethod(replace(next(r for r in SENSORS if r.name == "edi+stg"), **changed), PARTS)


def noise(stream: SpikeStream) -> SpikeStream:
    return replace(stream, packed=np.random.default_rng(0).integers(0, 256, stream.packed.shape, dtype=np.uint8))


@pytest.mark.parametrize("name", ["rgb-deblur+stg", "edi+4dgs"])  # each image, each loss, each motion
def test_no_spike_reaches_a_row_of_other_sensors(name: str, scene: TrainingScene) -> None:
    """A fit with noise in the place of all streams has the same bits."""
    method = METHODS[name]
    noisy = replace(scene, streams=tuple(map(noise, scene.streams)))
    images = [
        method.fit(training_for(method, s), QUICK).render(WORLD.held_out, scene.duration_us / 2) for s in (scene, noisy)
    ]
    assert np.isfinite(images[0]).all() and images[0].std() > 0.05
    np.testing.assert_array_equal(*images)


def test_one_frame_makes_a_static_model_that_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short = record(replace(WORLD, n_ticks=200), tmp_path, threshold=0.2)
    model = METHODS["rgb-deblur+stg"].fit(short, QUICK)
    assert "toy: one image of each camera shows no motion: a static model" in capsys.readouterr().err
    images = [model.render(WORLD.held_out, t) for t in (0.0, short.duration_us)]
    np.testing.assert_array_equal(*images)
    METHODS["edi+stg"].fit(short, QUICK)
    assert "static" not in capsys.readouterr().err


def test_a_fit_of_frames_resembles_the_scene(scene: TrainingScene) -> None:
    method = RecipeMethod(Recipe("short", "rgb", "rig", "static", "pixel", {"trainer.coarse_steps": 60}), PARTS)
    model = method.fit(scene, FitRequest(progress=silent))
    image = model.render(WORLD.held_out, scene.duration_us / 2)
    expected, _, board = WORLD.trace(WORLD.held_out, 0.5)
    assert -10 * np.log10(np.square(image - expected)[~board].mean()) > 22


@pytest.mark.parametrize("name", ["rgb-deblur+stg", "edi+4dgs"])
def test_a_warm_up_needs_no_recording(name: str) -> None:
    METHODS[name].warm_up(QUICK)  # type: ignore[attr-defined]
