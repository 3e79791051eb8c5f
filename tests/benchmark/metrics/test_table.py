import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.image_pair import ImagePair, check_images
from spike4dgs.benchmark.metrics.measure import Values, fit_gain, scene_means, scene_notes, score_image, select_metrics
from spike4dgs.benchmark.metrics.measure import measure as measure_pair
from spike4dgs.benchmark.metrics.metric import MAX_PSNR_DB, Images
from spike4dgs.benchmark.metrics.table import METRICS, PRIMARY

EVERYWHERE = np.ones((24, 40), bool)
CHOSEN = select_metrics(("psnr",))  # the metrics of linear images, which need nothing


def measure(truth: NDArray, prediction: NDArray, moving: NDArray, gain: float | None, where: str = "x") -> Values:
    """The values of the linear metrics of one image, after the checks that scoring does."""
    check_images(truth, prediction, moving, where)
    return measure_pair(ImagePair(truth, prediction, moving, where), gain, CHOSEN.metrics).values


def summary(per_image: dict[str, Values]) -> tuple[Values, dict[str, str]]:
    return scene_means(per_image), scene_notes(per_image, {}, CHOSEN)


def images(seed: int = 0, noise: float = 0.1) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    rng = np.random.default_rng(seed)
    truth = cv2.GaussianBlur(rng.random((24, 40)).astype(np.float32), (5, 5), 1.0)
    return truth, np.clip(truth + noise * rng.standard_normal(truth.shape), 0, 1).astype(np.float32)


def region(seed: int = 1) -> NDArray[np.bool_]:
    return np.random.default_rng(seed).random((24, 40)) < 0.2


def test_dynamic_metrics_use_only_the_moving_region() -> None:
    truth, _ = images()
    moving = np.zeros_like(EVERYWHERE)
    moving[8:16, 10:30] = True
    outside = np.where(moving, truth, 1 - truth)
    values = measure(truth, outside, moving, 1.0, "x")
    assert values["psnr_dynamic"] == MAX_PSNR_DB
    assert values["psnr"] is not None and values["psnr"] < 20
    everywhere = measure(truth, outside, EVERYWHERE, 1.0, "x")
    assert everywhere["psnr_dynamic"] == pytest.approx(everywhere["psnr"])


@given(gain=st.floats(0.2, 5), seed=st.integers(0, 3))
def test_aligned_metrics_do_not_depend_on_exposure(gain: float, seed: int) -> None:
    truth, prediction = images(seed)
    reference = measure(truth, prediction, EVERYWHERE, fit_gain([(truth, prediction)]), "x")
    dimmed = prediction.astype(np.float64) / gain
    values = measure(truth, dimmed, EVERYWHERE, fit_gain([(truth, dimmed)]), "x")
    for metric in METRICS.values():
        if metric.aligned:
            assert values[metric.id] == pytest.approx(reference[metric.id], abs=1e-6)


def test_the_gain_is_the_least_squares_one_over_all_images_of_a_scene() -> None:
    pairs = [images(seed) for seed in range(3)]
    dimmed = [(t, (p * 0.4).astype(np.float32)) for t, p in pairs]
    gain = fit_gain(dimmed)
    assert gain is not None
    stacked = np.concatenate([p.ravel() for _, p in dimmed])[:, None].astype(np.float64)
    expected = np.linalg.lstsq(stacked, np.concatenate([t.ravel() for t, _ in dimmed]).astype(np.float64), rcond=None)
    assert gain == pytest.approx(expected[0][0], rel=1e-9)


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_predictions_without_a_positive_gain_have_no_aligned_values(value: float) -> None:
    truth, _ = images()
    prediction = np.full_like(truth, value)
    gain = fit_gain([(truth, prediction)])
    assert gain is None
    metrics, notes = summary({"cam/000001": measure(truth, prediction, EVERYWHERE, gain, "x")})
    for m in CHOSEN.metrics:
        assert (metrics[m.id] is None) == (m.aligned or m.images in (Images.LATER, Images.COVISIBLE))
        assert (notes.get(m.id) == "no positive gain fits the predictions") == m.aligned


def test_scene_values_are_means_of_images_and_never_pooled() -> None:
    truth = np.full((24, 40), 0.5)
    per_image = {f"c/{i}": measure(truth, truth + e, EVERYWHERE, 1.0, "x") for i, e in enumerate((0.001, 0.1, 0.3))}
    expected = np.mean([60.0, 20.0, -20 * math.log10(0.3)])
    assert scene_means(per_image)["psnr"] == pytest.approx(expected, abs=1e-6)
    pooled = -10 * math.log10(np.mean([1e-6, 1e-2, 9e-2]))
    assert abs(pooled - expected) > 10


def test_identical_images_are_capped_and_noted() -> None:
    truth, prediction = images()
    shown = {"cam/000001": truth, "cam/000002": prediction}
    per_image = {name: measure(truth, image, EVERYWHERE, 1.0, "x") for name, image in shown.items()}
    assert per_image["cam/000001"]["psnr"] == MAX_PSNR_DB == per_image["cam/000001"]["psnr_dynamic"]
    assert per_image["cam/000001"]["ssim"] == pytest.approx(1)
    metrics, notes = summary(per_image)
    assert metrics["psnr"] == pytest.approx((MAX_PSNR_DB + per_image["cam/000002"]["psnr"]) / 2)
    assert notes["psnr"] == "1 without any error count as 100 dB, the first cam/000001"
    assert "ssim" not in notes


def test_an_image_without_motion_has_no_dynamic_value_and_is_noted() -> None:
    truth, prediction = images()
    without = measure(truth, prediction, ~EVERYWHERE, 1.0, "x")
    assert without["psnr_dynamic"] is None and without["ssim_dynamic_aligned"] is None and without["psnr"] is not None
    moving = measure(truth, prediction, region(), 1.0, "x")
    metrics, notes = summary({"a": without, "b": moving})
    assert metrics["psnr_dynamic"] == moving["psnr_dynamic"]
    assert notes["psnr_dynamic"] == "mean over the 1 of 2 images that have a moving region"
    metrics, notes = summary({"a": without})
    assert metrics["psnr_dynamic"] is None and notes["psnr_dynamic"] == "no image has a moving region"


@pytest.mark.parametrize(
    ("prediction", "moving", "message"),
    [
        (np.zeros((24, 39)), EVERYWHERE, "expected a gray image of shape (24, 40), found shape (24, 39)"),
        (np.full((24, 40), np.nan), EVERYWHERE, "expected a finite prediction, found 960 pixels that are not"),
        (np.zeros((24, 40)), np.ones((24, 41), bool), "expected a bool mask"),
    ],
)
def test_bad_images_are_refused(prediction: NDArray, moving: NDArray, message: str) -> None:
    with pytest.raises(UserError, match="cam_01/000004.exr") as e:
        measure(np.zeros((24, 40)), prediction, moving, 1.0, "cam_01/000004.exr")
    assert message in str(e.value)


def test_the_table_describes_every_metric_once() -> None:
    kinds = ("", "_dynamic", "_aligned", "_dynamic_aligned")
    linear = [f"{metric}{kind}" for kind in kinds for metric in ("psnr", "ssim")]
    shown = ["lpips_alex", "lpips_vgg", "lpips_squeeze", "flip", "brisque", "niqe", "metaiqa"]
    windows = [f"spike_psnr_{ticks}" for ticks in (5, 20, 80)]
    spikes = [f"{metric}{region}" for region in ("", "_dynamic") for metric in (*windows, "spike_deviance")]
    assert list(METRICS) == [*linear, "psnr_covisible", *shown, "temporal_error", *spikes]
    assert [m.id for m in METRICS.values() if m.takes == "spikes"] == spikes
    assert [m.id for m in METRICS.values() if m.takes == "srgb8"] == shown
    better = {m.id for m in METRICS.values() if m.higher_is_better}
    assert better == {*linear, "psnr_covisible", "metaiqa", *(m for m in spikes if "psnr" in m)}
    assert PRIMARY in METRICS
    for m in METRICS.values():
        assert m.title and m.definition and m.implementation and m.digits > 0 < m.tolerance
    assert METRICS["psnr"].format(21.987) == "21.99" and METRICS["ssim"].format(None) == "-"


def test_one_image_is_scored_by_every_metric_that_has_a_value() -> None:
    truth, prediction = images()
    values = score_image(truth, prediction, region(), metrics=("psnr", "flip"))
    without = {Images.LATER, Images.COVISIBLE}
    assert set(values) == {m.id for m in METRICS.values() if m.takes == "linear" and m.images not in without} | {"flip"}
    gain = fit_gain([(truth, prediction)])
    expected = measure(truth, prediction, region(), gain)
    assert {k: v for k, v in values.items() if k != "flip"} == {k: expected[k] for k in values if k != "flip"}
    without_region = score_image(truth, prediction, metrics=("psnr",))
    assert set(without_region) == {"psnr", "ssim", "psnr_aligned", "ssim_aligned"}


def test_a_metric_that_refuses_an_image_leaves_it_out() -> None:
    truth = images()[0]
    values = score_image(truth, np.full_like(truth, 0.5))
    assert "psnr" in values and not {"brisque", "niqe"} & set(values)
    with pytest.raises(UserError, match="image: expected a gray image of shape"):
        score_image(truth, truth[:-1])
