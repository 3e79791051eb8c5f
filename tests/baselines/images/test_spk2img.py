"""Spk2ImgNet's windows, training data, training, weight files, and its place among the image makers."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from resumed import check_resumed, same_tensors
from slow_images import stream_of
from small_scenes import GAIN, HEIGHT, WIDTH, add_gap, write_small_scene

from spike4dgs.baselines.images.spk2img import maker, train
from spike4dgs.baselines.images.spk2img.maker import WEIGHTS, Card, load_network
from spike4dgs.baselines.images.spk2img.network import Reconstruction, Spk2ImgNet
from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.cli.options import Compute
from spike4dgs.cli.train_spk2img import train_spk2img
from spike4dgs.method.images.base import window


@pytest.mark.parametrize("n", [3, 25, 41, 60])
def test_windows_beyond_the_clip_are_mirrored(n: int) -> None:
    spikes = np.random.default_rng(n).integers(0, 2, (n, 4, 6), dtype=np.uint8)
    longer = np.pad(spikes, ((20, 20), (0, 0), (0, 0)), mode="symmetric")
    for tick in {0, 1, n // 2, n - 1}:
        np.testing.assert_array_equal(window(stream_of(spikes), tick), longer[tick : tick + 41])


def dawn(height: int = 20, width: int = 31) -> train.Example:
    """An image that is dark until tick 50; then some pixels fire at every tick. The truth is that pattern."""
    lit = np.random.default_rng(5).random((height, width)) < 0.4
    spikes = np.zeros((100, height, width), np.uint8)
    spikes[50:] = lit
    moving = np.array([0, height * width - 1, 7 * width + 11])
    return train.Example(stream_of(spikes), 50, lit.astype(np.float32), moving, GAIN)


def test_augmented_patches_fit_their_truth_in_space_and_time() -> None:
    """Turned, flipped, reversed or not: pixels change at the start of the middle tick, where the truth says so."""
    batch = train.draw([dawn()], 64, 16, 0.5, np.random.default_rng(0))
    assert batch.spikes.shape == (64, 41, 16, 16) and batch.spikes.dtype == batch.rate.dtype == np.float32
    forward = 0
    for spikes, rate in zip(batch.spikes, batch.rate, strict=True):
        before, after = spikes[19], spikes[20]
        bright, dark = (after, before) if after.any() else (before, after)
        np.testing.assert_array_equal(bright, rate)
        assert not dark.any()
        assert (spikes[:20] == before).all() and (spikes[20:] == after).all()
        forward += bool(after.any())
    assert 16 < forward < 48
    assert len({rate.tobytes() for rate in batch.rate}) > 50
    np.testing.assert_array_equal(batch.gain, np.float32(GAIN))


def test_patches_around_motion_hold_a_moving_pixel() -> None:
    """A truth that is 1 at the only moving pixel: every patch drawn on motion contains it."""
    rate = np.zeros((20, 31), np.float32)
    rate[3, 30] = 1
    example = train.Example(stream_of(np.zeros((100, 20, 31), np.uint8)), 50, rate, np.array([3 * 31 + 30]), GAIN)
    batch = train.draw([example], 40, 10, 1.0, np.random.default_rng(1))
    np.testing.assert_array_equal(batch.rate.sum(axis=(1, 2)), 1)
    anywhere = train.draw([example], 40, 10, 0.0, np.random.default_rng(1))
    assert anywhere.rate.sum() < 30


def test_examples_are_all_images_of_a_scene(small_scene: Path) -> None:
    examples = train.read_examples(train.open_for_training(small_scene))
    assert [e.tick for e in examples] == [20, 40, 60]
    scene = open_scene(small_scene)
    for example, target in zip(examples, scene.targets, strict=True):
        np.testing.assert_allclose(example.rate, GAIN * scene.ground_truth(target), rtol=1e-6)
        np.testing.assert_array_equal(example.moving, np.flatnonzero(scene.moving(target)))
        assert example.stream.packed.tobytes() == scene.stream("cam_03").packed.tobytes()


def test_the_public_benchmark_and_seasons_are_refused(small_scene: Path) -> None:
    meta = json.loads((small_scene / "scene.json").read_text())
    public, season = ", such as 1, found the public", ", found variant 9000, which is kept for hidden seasons"
    for variant, refused in ((0, public), (1, ""), (8999, ""), (9000, season)):
        meta["source"]["variant"] = variant
        (small_scene / "scene.json").write_text(json.dumps(meta))
        write_manifest(small_scene)
        if refused:
            with pytest.raises(UserError, match=f"expected a training variant{refused}"):
                train.open_for_training(small_scene)
        else:
            assert train.open_for_training(small_scene).id == "pattern-0"


@pytest.mark.parametrize(
    ("camera", "first_tick", "ticks", "kept"),
    [
        ("cam_03", 0, 19, [40, 60]),  # tick 40 needs ticks [19, 60], the reversed window's first included
        ("cam_03", 19, 1, [60]),
        ("cam_03", 60, 1, [20]),
        ("cam_03", 61, 1, [20, 40]),
        ("cam_02", 0, 80, [20, 40, 60]),  # no image is of this camera
    ],
)
def test_images_whose_spikes_lack_ticks_are_not_trained_on(
    small_scene: Path, camera: str, first_tick: int, ticks: int, kept: list[int]
) -> None:
    add_gap(small_scene, camera, first_tick, ticks)
    assert [e.tick for e in train.read_examples(train.open_for_training(small_scene, allow_gaps=True))] == kept


def test_gaps_are_refused_unless_allowed(small_scene: Path, tmp_path: Path) -> None:
    add_gap(small_scene, "cam_03", 0, 80)
    with pytest.raises(UserError, match="a recording without gaps"):
        train_spk2img(scenes=(small_scene,), out=tmp_path / "out")
    with pytest.raises(UserError, match="with ground truth, found no image that has all its spikes"):
        train_spk2img(scenes=(small_scene,), out=tmp_path / "out", allow_gaps=True)


def test_loss_from_its_definition() -> None:
    rng = np.random.default_rng(0)
    rate, truth = rng.random((2, 6, 6)), rng.random((2, 6, 6))
    estimates, gain = rng.random((2, 5, 4, 6, 6)), np.array([0.5, 2.0])
    expected = 0.0
    for b in range(2):
        expected += np.abs(rate[b] - truth[b]).mean() / gain[b] / 2
        for branch in range(4):
            expected += 0.02 * 5 * np.abs(estimates[b, 2, branch] - truth[b]).mean() / gain[b] / 2
    found = Reconstruction(torch.from_numpy(rate), torch.from_numpy(estimates))
    loss = train.loss_of(found, torch.from_numpy(truth), torch.from_numpy(gain), 0.02)
    assert loss.item() == pytest.approx(expected, rel=1e-12)
    perfect = Reconstruction(torch.from_numpy(truth), torch.from_numpy(truth)[:, None, None].expand(2, 5, 4, 6, 6))
    assert train.loss_of(perfect, torch.from_numpy(truth), torch.from_numpy(gain), 0.02).item() == 0


SMALL = train.TrainingSettings(width=4, steps=25, batch=2, patch=16, warm_up=5, lr=5e-3)


def test_training_learns(small_scene: Path) -> None:
    training = train.Training(train.read_examples(train.open_for_training(small_scene)), SMALL, "cpu", seed=1)
    losses = [training.train_step() for _ in range(SMALL.steps)]
    assert np.mean(losses[-8:]) < 0.6 * np.mean(losses[:4])


def test_a_step_without_a_finite_gradient_changes_nothing(small_scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    training = train.Training(train.read_examples(train.open_for_training(small_scene)), SMALL, "cpu", seed=3)
    before = {name: value.clone() for name, value in training.network.state_dict().items()}
    monkeypatch.setattr(train, "loss_of", lambda found, *_: (found.rate * float("inf")).sum())
    training.train_step()
    assert training.step == 1
    same_tensors(training.network.state_dict(), before)


def test_a_resumed_training_gives_the_bits_of_one_that_never_stopped(small_scene: Path, tmp_path: Path) -> None:
    examples = train.read_examples(train.open_for_training(small_scene))
    check_resumed(lambda: train.Training(examples, SMALL, "cpu", seed=2), tmp_path / "c.safetensors")


def test_command_to_weights_to_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    one, two = write_small_scene(tmp_path / "one", seed=1), write_small_scene(tmp_path / "two", seed=2)
    out = tmp_path / "out"
    arguments = {"scenes": (one,), "hidden": (two,), "out": out, "width": 2, "steps": 2, "compute": Compute("cpu")}
    assert train_spk2img(**arguments) == 0
    assert "step 2/2, loss" in capsys.readouterr().out
    path = out / "spk2img-2.safetensors"
    card, scene = WEIGHTS.read_card(path), open_scene(two)
    assert (card.width, card.steps, card.seed) == (2, 2, 0)
    assert card.trained_on == (f"pattern-1@{open_scene(one).revision[:16]}",)
    assert list(card.hidden_psnr_db) == ["pattern-2"] and 0 < card.hidden_psnr_db["pattern-2"] < 40
    before = path.read_bytes()
    assert train_spk2img(**arguments) == 0  # done already
    assert path.read_bytes() == before

    monkeypatch.setenv(WEIGHTS.variable, str(path))
    stream = scene.stream("cam_03")
    images = IMAGES["spk2img"](stream, [0, 40, 79], GAIN)
    assert images.shape == (3, HEIGHT, WIDTH) and images.dtype == np.float32
    network = load_network(path, "cpu")
    with torch.inference_mode():
        expected = network(torch.from_numpy(window(stream, 40)[None].astype(np.float32))).rate[0].clamp(min=0)
    np.testing.assert_allclose(images[1], expected.numpy() / GAIN, atol=1e-5)
    assert (images >= 0).all()


def test_hidden_scenes_are_not_trained_on(small_scene: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--hidden: expected scenes that are not trained on, found pattern-0"):
        train_spk2img(scenes=(small_scene,), hidden=(small_scene,), out=tmp_path / "out")
    with pytest.raises(UserError, match="--scenes: expected scene folders, found none"):
        train_spk2img(scenes=(), out=tmp_path / "out")
    with pytest.raises(UserError, match="--width and --steps: expected numbers from 1 up, found 8, 0"):
        train_spk2img(scenes=(small_scene,), steps=0, out=tmp_path / "out")


def test_missing_weights_say_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = stream_of(np.ones((50, 6, 9), np.uint8))
    monkeypatch.setenv(WEIGHTS.variable, str(tmp_path / "none.safetensors"))
    with pytest.raises(UserError, match=r"none\.safetensors: expected weights of Spk2ImgNet, found no such file; "):
        IMAGES["spk2img"](stream, [25], GAIN)
    monkeypatch.delenv(WEIGHTS.variable)
    monkeypatch.setattr(maker, "WEIGHTS", replace(WEIGHTS, shipped=tmp_path / "spk2img-8.safetensors"))
    with pytest.raises(UserError, match=r"spk2img-8.*`spike4dgs train-spk2img`, or set SPIKE4DGS_SPK2IMG to a file"):
        IMAGES["spk2img"](stream, [25], GAIN)


def test_weights_of_another_width_than_their_card_says_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    WEIGHTS.save(path, Spk2ImgNet(4), Card(8, 7, 1, (), {}))
    with pytest.raises(
        UserError, match=r"parameters of width 8, found \d+ other tensors, the first align\S+ \(4,\); t"
    ):
        load_network(path, "cpu")


def test_the_weights_have_learnt_to_leave_out_what_a_sensor_has_in_the_dark() -> None:
    dark, phase, ticks = 0.005, np.random.default_rng(0).random((24, 32)), np.arange(62)[:, None, None]
    for light in (0.02, 0.06, 0.12):
        spikes = np.diff(np.floor(phase + (light + dark) * ticks), axis=0) > 0
        found = maker.spk2img_image(stream_of(spikes), 30, "cpu").mean()
        assert abs(found - light) < 0.6 * abs(found - light - dark)


def test_a_calibration_takes_off_what_the_network_has_left_of_the_dark() -> None:
    """That is how far a pixel's dark rate is from the camera's mean; a dead pixel has no part in the mean."""
    rng = np.random.default_rng(1)
    light, gain, dark = (
        rng.uniform(*bounds, (6, 7)).astype(np.float32) for bounds in ((0.1, 0.8), (0.9, 1.1), (0, 0.01))
    )
    gain[2, 3], dark[2, 3] = 0, 0.5
    camera = Calibration(gain, dark, 0.6)
    learnt = 0.6 * light * gain + dark - dark[gain > 0].mean()
    spk2img = replace(IMAGES["spk2img"], rate=lambda *_: learnt.copy())
    found = spk2img(stream_of(np.zeros((9, 6, 7), bool)), [4], gain=0.6, camera=camera)[0]
    assert np.isnan(found[2, 3])
    np.testing.assert_allclose(found[gain > 0], light[gain > 0], rtol=1e-5)
