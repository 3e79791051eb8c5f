import numpy as np
import pytest
from splat_scenes import random_splats, views

from spike4dgs.method.splat import render
from spike4dgs.studies.kit.measurement import Request
from spike4dgs.studies.speed_error.splat import beside_torch, exact_image, gradients, precision

REQUEST = Request("tiny", 1, lambda: pytest.fail("no scene is needed"))
FAR = "10 km from the origin"


def test_the_exact_image_in_parts_is_the_reference() -> None:
    splats, camera = random_splats(80, seed=2), views(1)
    whole = render(splats, camera, backend="reference").image[0]
    np.testing.assert_allclose(exact_image(splats, camera).numpy(), whole.numpy(), atol=1e-12)


def test_the_kernels_agree_with_float64_near_the_origin_and_far_from_it() -> None:
    for series in precision.run(REQUEST):
        exact, wide, narrow = series.points
        assert (exact.role, narrow.role) == ("exact", "chosen") and exact.values["max"] == 0
        assert wide.values["rms"] < 1e-6 and (wide.values["sure"] or 0) < 1e-5, series.name
        assert (narrow.values["rms"] < 1e-6) == (series.name != FAR), "float32 is lost far from the origin alone"


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
