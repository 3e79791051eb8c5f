import numpy as np
import pytest
from splat_scenes import random_splats, views

from spike4dgs.method.splat import render
from spike4dgs.method.splat.kernels.vector_ir import EXP2_POLYNOMIAL
from spike4dgs.method.splat.types import ALPHA_MIN, T_MIN
from spike4dgs.studies.kit.measurement import Request
from spike4dgs.studies.speed_error import cuts

REQUEST = Request("tiny", 1, lambda: pytest.fail("no scene is needed"))


@pytest.mark.parametrize(("polynomial", "limit"), [(EXP2_POLYNOMIAL, 3e-7), (cuts.fitted_polynomial(2), 3e-3)])
def test_the_vector_code_raises_two_to_a_power(polynomial: tuple[float, ...], limit: float) -> None:
    x = np.linspace(-20, 20, 1600, dtype=np.float32)
    out = np.empty_like(x)
    cuts.exp2_kernel(polynomial)(x, out)
    error = np.abs(out / np.exp2(x.astype(np.float64)) - 1).max()
    assert limit / 10 < error < limit


def test_at_the_rasterisers_limits_the_cut_image_is_the_references() -> None:
    splats, camera = random_splats(80, seed=2), views(1)
    image, pairs = cuts.composited(splats, camera, ALPHA_MIN, T_MIN)
    whole = render(splats, camera, backend="reference").image[0, ..., 0]
    np.testing.assert_allclose(image.reshape(whole.shape).numpy(), whole.numpy(), atol=1e-12)
    assert 0 < pairs < 80


@pytest.mark.parametrize("m", [cuts.extent, cuts.transmittance], ids=lambda m: m.id)
def test_a_wider_cut_does_less_and_errs_more(m: object) -> None:
    for series in m.run(REQUEST):  # type: ignore[attr-defined]
        pairs = [p.values["pairs"] for p in series.points]
        rms = [p.values["rms"] for p in series.points]
        assert pairs == sorted(pairs, reverse=True) and rms == sorted(rms)
        assert series.points[0].role == "exact" and rms[0] == 0 and sum(p.role == "chosen" for p in series.points) == 1


def test_a_compensated_filter_of_a_pixel_is_nearest_to_the_pixels_square() -> None:
    for series in cuts.pixel_filter.run(REQUEST):
        rms = {p.name: p.values["rms"] for p in series.points}
        assert min(rms, key=lambda name: rms[name] or np.inf) == "1/12, compensated"
        assert rms["1/12, compensated"] < 0.2 * rms["0.3"]
