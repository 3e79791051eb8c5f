import pytest

from spike4dgs.studies.kit.measurement import Request
from spike4dgs.studies.speed_error.networks import fused_ssim, lookup, msdi_images

REQUEST = Request("tiny", 1, lambda: pytest.fail("no scene is needed"))


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
