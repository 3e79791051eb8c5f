"""Ground truth on disk, and the audit."""

from __future__ import annotations

import numpy as np
import pytest

from spike4dgs.generators.truth import _total, errors, moving_region


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
    assert found["mean_percent"] == pytest.approx(5, abs=1e-3) and found["mean_percent_moving"] == pytest.approx(
        10, abs=1e-3
    )
    assert found["mean_absolute"] == pytest.approx(0.025, abs=1e-4)
    assert "psnr_db_moving" not in errors(image, truth, np.zeros((10, 10), bool))


def test_totals_are_over_the_images_with_a_value():
    rows = [{"tick": 1, "psnr_db": 40.0}, {"tick": 2, "psnr_db": 30.0, "psnr_db_moving": 20.0}]
    assert _total(rows) == {"psnr_db": 35.0, "psnr_db_moving": 20.0}
