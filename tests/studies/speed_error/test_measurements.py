"""Measurements of the report in their smallest size: each says of its twins what its page says."""

import numpy as np
import pytest
from splat_scenes import random_splats, views

from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.generators.sensor.model import Sensor, random_charge
from spike4dgs.generators.sensor.reference import simulate_reference
from spike4dgs.method.splat import render
from spike4dgs.studies.kit.measurement import Request
from spike4dgs.studies.speed_error import growth
from spike4dgs.studies.speed_error.networks import fused_ssim, lookup, msdi_images
from spike4dgs.studies.speed_error.scores import decoding, flip_score
from spike4dgs.studies.speed_error.sensor import integration, light
from spike4dgs.studies.speed_error.splat import beside_torch, exact_image, gradients, precision

REQUEST = Request("tiny", 1, lambda: pytest.fail("no scene is needed"))


def test_every_metric_of_images_is_timed() -> None:
    found = {s.name: s.points for s in growth.metrics.run(REQUEST)}
    assert set(found) == {m.id for m in METRICS.values() if not m.aligned and m.takes != "spikes"}
    assert all(p.values["ms"] > 0 and p.values["pixels"] == 96 * 192 for points in found.values() for p in points)


def test_the_lookups_kernels_agree_with_float64() -> None:
    for series in lookup.run(REQUEST):
        assert max(p.values["max"] for p in series.points) < 1e-5
        assert max(p.values["gradient"] for p in series.points) < 1e-4, series.name


@pytest.mark.slow
def test_bfloat16_changes_an_image_less_than_a_spike_in_a_window() -> None:
    for series in msdi_images.run(REQUEST):
        rms = {p.name: p.values["rms"] for p in series.points}
        assert rms["float32"] < 1e-5 < rms["convolutions in bfloat16"] < 1 / 41


def test_ssim_keeps_its_digits_where_variances_do_not_cancel() -> None:
    chosen = {s.name: next(p.values for p in s.points if p.role == "chosen") for s in fused_ssim.run(REQUEST)}
    for name in ("random images", "almost black"):
        assert chosen[name]["value"] < 1e-6 and chosen[name]["gradient"] < 1e-5
    assert chosen["radiance 50 with noise of 0.001"]["gradient"] > 0.1, "the hard case is one"


def test_scores_and_decoded_spikes_differ_from_their_twins_by_rounding() -> None:
    limits = {"flip": 1e-5, "decoding": 0.0}
    for m in (flip_score, decoding):
        for series in m.run(REQUEST):
            exact, chosen = (next(p for p in series.points if p.role == role) for role in ("exact", "chosen"))
            assert exact.values["error"] == 0
            assert chosen.values["error"] <= limits[m.id], f"{m.id}, {series.name}"
            assert all(p.values["ms"] > 0 for p in series.points)


def test_a_count_is_off_by_one_spike_at_most_in_every_light() -> None:
    for series in integration.run(REQUEST):
        exact, *others = series.points
        assert exact.role == "exact" and exact.values["off"] == 0
        assert max(p.values["most"] for p in others if p.name.startswith("kernel")) <= 1
        assert others[-1].values["off"] < 1, series.name


def test_the_lights_are_what_their_names_say() -> None:
    keys = light(1, 12, 20, 4)
    rates = {}
    for name, images in keys.items():
        spikes = simulate_reference(images, [0, 10, 20, 30], 30, Sensor(), random_charge(12, 20, [1]))
        rates[name] = spikes.mean()
    assert rates["almost dark, 0.001"] < 0.01 < rates["a drifting pattern"] < 0.8 < rates["glaring, 10 x white"]
    assert np.ptp(keys["half of it static"][:, :, -1], axis=0).max() == 0


def test_the_exact_image_in_parts_is_the_reference() -> None:
    splats, camera = random_splats(80, seed=2), views(1)
    whole = render(splats, camera, backend="reference").image[0]
    np.testing.assert_allclose(exact_image(splats, camera).numpy(), whole.numpy(), atol=1e-12)


def test_the_kernels_agree_with_float64_near_the_origin_and_far_from_it() -> None:
    for series in precision.run(REQUEST):
        exact, wide, narrow = series.points
        assert (exact.role, narrow.role) == ("exact", "chosen") and exact.values["max"] == 0
        assert wide.values["rms"] < 1e-6 and (wide.values["sure"] or 0) < 1e-5, series.name
        far = series.name == "10 km from the origin"
        assert (narrow.values["rms"] > 1e-6) == far, "float32 is lost far from the origin alone"


def test_gradients_agree() -> None:
    ((_, kernels),) = (s.points for s in gradients.run(REQUEST))
    errors = {k: v for k, v in kernels.values.items() if "ms" not in k}
    assert len(errors) == 5 and max(errors.values()) < 1e-4


def test_metal_gauss_renders_the_same_but_for_its_cut() -> None:
    pytest.importorskip("metal_gauss")
    found = {s.name: s.points[0].values for s in beside_torch.run(REQUEST)}
    assert len(found) == 6 and all(v["ms"] > 0 for v in found.values())
    ours = found["spike4dgs, with gradients, 1 channel"]
    assert 0 < ours["image"] < 0.05 and 0 < ours["gradient"] < 0.05
    assert "gradient" not in found["spike4dgs, with gradients, 3 channels"]
