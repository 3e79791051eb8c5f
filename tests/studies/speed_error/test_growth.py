from __future__ import annotations

import pytest

from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.studies.kit.measurement import Request
from spike4dgs.studies.speed_error import growth

REQUEST = Request("tiny", 1, "cpu", lambda: pytest.fail("no scene is needed"))


@pytest.mark.parametrize("m", [growth.sensor_pixels, growth.sensor_clip, growth.sensor_threads], ids=lambda m: m.id)
def test_costs_are_measured_for_every_size(m: object) -> None:
    for series in m.run(REQUEST):  # type: ignore[attr-defined]
        assert len({p.values[m.x] for p in series.points}) == len(series.points) > 0  # type: ignore[attr-defined]
        assert all(p.values["ms"] > 0 for p in series.points)


def test_every_metric_is_timed() -> None:
    found = {s.name: s.points for s in growth.metrics.run(REQUEST)}
    assert set(found) == {m.id for m in METRICS.values() if not m.aligned}
    assert all(p.values["ms"] > 0 and p.values["pixels"] == 96 * 192 for points in found.values() for p in points)
