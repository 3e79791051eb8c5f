"""Perceptual, no-reference and temporal metrics as a scene is scored: refusals, means, notes."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from skimage.data import camera
from small_scenes import write_small_scene

from spike4dgs.benchmark import METRICS, Scene, UserError, open_scene, score_predictions, write_predictions
from spike4dgs.benchmark.metrics.flip import flip
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.metrics.measure import Measured, Selection, measure, scene_means, scene_notes, select_metrics
from spike4dgs.benchmark.runs.record import check_record, read_record
from spike4dgs.benchmark.scene.images import encode_srgb, read_exr, write_exr
from spike4dgs.benchmark.weights import VARIABLE
from spike4dgs.cli.score import score

ALWAYS = ("flip", "brisque", "niqe")  # of the sRGB-encoded image, without weights


@pytest.fixture(autouse=True)
def no_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.delenv(VARIABLE, raising=False)


def radiance(seed: int = 0) -> NDArray[np.float64]:
    """A photograph as linear light [200, 256]."""
    rows = camera()[100 + seed : 300 + seed, 100:356]
    return (rows / 255.0) ** 2.2


def values_of(prediction: NDArray, truth: NDArray | None = None, *ids: str) -> Measured:
    truth = radiance() if truth is None else truth
    pair = ImagePair(truth, prediction, np.ones(truth.shape, bool), "p/cam/000001.exr")
    return measure(pair, 1.0, [METRICS[i] for i in ids or ALWAYS])


def test_perceptual_metrics_take_the_srgb_encoded_image() -> None:
    from spike4dgs.benchmark.metrics.iqa.brisque import brisque
    from spike4dgs.benchmark.metrics.iqa.niqe import niqe

    truth, prediction = radiance(), np.clip(radiance(3) * 1.3, 0, 1)
    shown = encode_srgb(prediction)
    values = values_of(prediction, truth).values
    assert values["flip"] == flip(encode_srgb(truth), shown)
    assert values["brisque"] == brisque(shown) and values["niqe"] == niqe(shown)
    assert values["psnr"] is None, "only what was asked for"
    rounded = shown[100, 100] / 255
    assert rounded == pytest.approx(1.055 * prediction[100, 100] ** (1 / 2.4) - 0.055, abs=0.51 / 255)


def test_values_outside_the_range_are_clipped_before_encoding() -> None:
    bright = np.where(radiance() > 0.5, 7.0, radiance())
    assert values_of(bright).values == values_of(np.minimum(bright, 1)).values


def test_black_never_scores_well() -> None:
    truth, rng = radiance(), np.random.default_rng(0)
    poor = np.clip(truth + 0.03 * rng.standard_normal(truth.shape), 0, 1)
    ids = ("psnr", "ssim", "flip")
    black, ours = (values_of(p, None, *ids).values for p in (np.zeros_like(truth), poor))
    for i in ids:
        a, b = black[i], ours[i]
        assert a is not None and b is not None and ((b > a) == METRICS[i].higher_is_better) and a != b


def sequence(*images: float | NDArray, truth: tuple[float, ...] = (0.1, 0.2, 0.4), step_ms: float = 2.0) -> list[Any]:
    """temporal_error along a clip whose truth is even; a number is that level plus a fixed pattern."""
    pattern = 0.05 * np.sin(np.arange(16 * 20)).reshape(16, 20)
    pairs: list[ImagePair] = []
    for level, image in zip(truth, images, strict=True):
        shown = pattern + image if np.isscalar(image) else np.asarray(image)
        earlier = {"earlier": pairs[-1], "since_ms": step_ms} if pairs else {}
        pairs.append(ImagePair(pattern + level, shown, np.ones((16, 20), bool), "x", **earlier))
    return [measure(p, 2.0, [METRICS["temporal_error"]]) for p in pairs]


def test_temporal_error_is_the_mean_difference_of_the_rates() -> None:
    found = [m.values["temporal_error"] for m in sequence(0.3, 0.35, 0.65)]
    assert found[0] is None
    assert found[1:] == [pytest.approx(abs(0.05 - 0.1) / 2), pytest.approx(abs(0.3 - 0.2) / 2)]
    halved = [m.values["temporal_error"] for m in sequence(0.3, 0.35, 0.65, step_ms=4.0)]
    assert halved[1:] == [pytest.approx(v / 2) for v in found[1:]]
    same_error, same_image = ([m.values["temporal_error"] for m in sequence(*x)] for x in ((0.2, 0.3, 0.5), [0.3] * 3))
    assert same_error[1:] == [pytest.approx(0, abs=1e-12)] * 2
    assert same_image[1:] == [pytest.approx(0.05), pytest.approx(0.1)], "the truth's own rate"


def test_even_images_have_no_temporal_error() -> None:
    black = np.zeros((16, 20))
    found = sequence(0.3, black, 0.65)
    assert [m.values["temporal_error"] for m in found] == [None, None, None]
    assert [bool(m.refused) for m in found] == [False, True, True]


def row(**values: float | None) -> dict[str, float | None]:
    return dict.fromkeys(METRICS) | values


def test_means_leave_out_only_what_the_dataset_leaves_out() -> None:
    everything = {
        "a/000040": row(flip=0.2, temporal_error=0.4, psnr_dynamic=None),
        "a/000020": row(flip=0.4, temporal_error=None, psnr_dynamic=20.0),
        "b/1000000": row(flip=0.6, temporal_error=0.2, psnr_dynamic=30.0),
        "b/999980": row(flip=0.8, temporal_error=None, psnr_dynamic=None),
    }
    means = scene_means(everything)
    assert (means["flip"], means["temporal_error"], means["psnr_dynamic"]) == pytest.approx((0.5, 0.3, 25.0))
    notes = scene_notes(everything, {}, select_metrics())
    assert notes["temporal_error"] == "mean over the 2 of 4 images that have an earlier one of their camera"
    assert "flip" not in notes and notes["lpips_vgg"].startswith("not computed: needs the file vgg16-397923af.pth")
    refused = {**everything, "a/000040": row(flip=None, temporal_error=None)}
    means = scene_means(refused)
    assert means["flip"] is None and means["temporal_error"] is None, "no method gains by a refused image"
    notes = scene_notes(refused, {"a/000040": {"flip": "even"}}, select_metrics())
    assert notes["flip"] == "1 of 4 images refused, the first a/000040: even"


def test_single_targets_have_no_temporal_error() -> None:
    per_image = {"a/1": row(), "b/1": row()}
    assert scene_means(per_image)["temporal_error"] is None
    assert scene_notes(per_image, {}, select_metrics())["temporal_error"] == "no camera has two targets"


def test_the_hash_of_weights_that_users_choose_is_in_the_note() -> None:
    selection = select_metrics()
    chosen = Selection({**selection.weights, "metaiqa": "ab" * 32, "lpips_alex": "cd" * 32}, {})
    chosen = Selection(chosen.weights, {m: "x" for m in METRICS if m not in chosen.weights})
    notes = scene_notes({"a/1": row(metaiqa=0.5, lpips_alex=0.1)}, {}, chosen)
    assert notes["metaiqa"] == f"weights with sha256 {'ab' * 32}" and "lpips_alex" not in notes


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return open_scene(write_small_scene(tmp_path_factory.mktemp("scene") / "s"))


def predict(root: Path, scene: Scene, change: Any = lambda tick, image: image) -> Path:
    images = {t: change(t.tick, scene.ground_truth(t)) for t in reversed(scene.targets)}
    return write_predictions(root, scene, images, "mine")


def test_a_scenes_temporal_error_follows_the_targets_in_time(scene: Scene, tmp_path: Path) -> None:
    root = predict(tmp_path / "p", scene, lambda tick, image: image * (0.5 if tick == 40 else 1.0))
    record = score_predictions(root, [scene], select_metrics())
    cell = record["scenes"][scene.id]
    images = {t: scene.ground_truth(t).astype(np.float64) for t in scene.targets}
    shown = {t: read_exr(root / f"{t.name}.exr").astype(np.float64) for t in scene.targets}
    first, second, third = sorted(images, key=lambda t: t.tick)
    for a, b in ((first, second), (second, third)):
        expected = np.abs((shown[b] - shown[a]) - (images[b] - images[a])).mean()
        assert cell["per_image"][b.name]["temporal_error"] == pytest.approx(expected, rel=1e-9)  # 20 ticks are 1 ms
    assert cell["per_image"][first.name]["temporal_error"] is None
    assert "temporal_error" in cell["computed"] and "lpips_alex" not in cell["computed"]


def test_a_black_prediction_gets_reasons_and_no_good_values(scene: Scene, tmp_path: Path) -> None:
    record = score_predictions(predict(tmp_path / "p", scene, lambda _, image: 0 * image), [scene], select_metrics())
    cell = record["scenes"][scene.id]
    for metric in ("brisque", "niqe", "temporal_error"):
        assert cell["metrics"][metric] is None
        assert "expected an image of something, found the level 0 of 255 everywhere" in cell["notes"][metric]
    assert cell["metrics"]["flip"] > 0.5 and cell["metrics"]["psnr"] < 10


def test_metrics_of_a_command_line_are_in_its_record(scene: Scene, tmp_path: Path) -> None:
    root = predict(tmp_path / "p", scene)
    assert score(root, (scene.root,), out=tmp_path / "r.json", metrics=("flip",)) == 0
    cell = read_record(tmp_path / "r.json")["scenes"][scene.id]
    assert "flip" in cell["computed"] and "brisque" not in cell["computed"]
    assert cell["notes"]["brisque"] == "not computed: not asked for"
    with pytest.raises(UserError, match=r"alexnet-owt-7be5be79\.pth: expected .* found no such file; run `spike4dgs "):
        score(root, (scene.root,), metrics=("auto", "lpips_alex"))


def test_a_weight_file_makes_its_metric_count(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    from spike4dgs.benchmark.metrics.iqa.metaiqa import metaiqa_network

    torch.manual_seed(0)
    torch.save(metaiqa_network().state_dict(), tmp_path / "metaiqa_resnet18.pth")
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    root = predict(tmp_path / "p", scene)
    record = score_predictions(root, [scene], select_metrics())
    cell = record["scenes"][scene.id]
    sha256 = cell["computed"]["metaiqa"]
    assert 0 < cell["metrics"]["metaiqa"] < 1 and cell["notes"]["metaiqa"] == f"weights with sha256 {sha256}"
    check_record(json.loads(json.dumps(record)), "r")


def test_damaged_truth_is_an_error_all_the_same(scene: Scene, tmp_path: Path) -> None:
    root = predict(tmp_path / "p", scene)
    copy = Path(shutil.copytree(scene.root, tmp_path / "copy"))
    target = scene.targets[0]
    write_exr(copy / f"images/{target.name}.exr", np.zeros((24, 40), np.float32), 0.0)
    with pytest.raises(UserError, match="sha256|bytes"):
        score_predictions(root, [open_scene(copy)], select_metrics())
