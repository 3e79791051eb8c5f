from __future__ import annotations

import numpy as np
import pytest

from spike4dgs.studies.kit.measurement import Request
from spike4dgs.studies.speed_error.scores import decoding, flip_score, pairs, psnr_slowly, scores, ssim_slowly

REQUEST = Request("tiny", 1, "cpu", lambda: pytest.fail("no scene is needed"))


def test_the_slow_scores_are_those_of_scikit_image() -> None:
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    for pair in pairs(REQUEST).values():
        a, b = pair.truth, pair.prediction
        options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1}
        assert np.isclose(ssim_slowly(a, b), structural_similarity(a, b, **options), atol=1e-12)
        assert np.isclose(psnr_slowly(a, b), peak_signal_noise_ratio(a, b, data_range=1), atol=1e-9)


def test_scores_and_decoded_spikes_differ_from_their_twins_by_rounding() -> None:
    limits = {"scores": 1e-9, "flip": 1e-5, "decoding": 0.0}
    for m in (scores, flip_score, decoding):
        for series in m.run(REQUEST):
            exact, chosen = (next(p for p in series.points if p.role == role) for role in ("exact", "chosen"))
            assert exact.values["error"] == 0
            assert chosen.values["error"] <= limits[m.id], f"{m.id}, {series.name}"
            assert all(p.values["ms"] > 0 for p in series.points)


def test_eight_bits_change_a_score() -> None:
    off = {s.name: next(p for p in s.points if "8-bit" in p.name).values["error"] for s in scores.run(REQUEST)}
    assert off["PSNR of almost equal images"] > 1 > 1e-2 > off["SSIM of a noisy image"]
