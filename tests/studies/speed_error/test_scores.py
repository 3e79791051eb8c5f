import pytest

from spike4dgs.studies.kit.measurement import Request
from spike4dgs.studies.speed_error.scores import decoding, flip_score

REQUEST = Request("tiny", 1, lambda: pytest.fail("no scene is needed"))


def test_scores_and_decoded_spikes_differ_from_their_twins_by_rounding() -> None:
    limits = {"flip": 1e-5, "decoding": 0.0}
    for m in (flip_score, decoding):
        for series in m.run(REQUEST):
            exact, chosen = (next(p for p in series.points if p.role == role) for role in ("exact", "chosen"))
            assert exact.values["error"] == 0
            assert chosen.values["error"] <= limits[m.id], f"{m.id}, {series.name}"
            assert all(p.values["ms"] > 0 for p in series.points)
