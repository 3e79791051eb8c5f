import pytest

from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.studies.kit.measurement import Request
from spike4dgs.studies.speed_error import growth


def test_every_metric_of_images_is_timed() -> None:
    request = Request("tiny", 1, lambda: pytest.fail("no scene is needed"))
    found = {s.name: s.points for s in growth.metrics.run(request)}
    assert set(found) == {m.id for m in METRICS.values() if not m.aligned and m.takes != "spikes"}
    assert all(p.values["ms"] > 0 and p.values["pixels"] == 96 * 192 for points in found.values() for p in points)
