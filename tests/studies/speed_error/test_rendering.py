from __future__ import annotations

import pytest

from spike4dgs.studies.kit.measurement import Request
from spike4dgs.studies.speed_error.rendering import soft_light


@pytest.mark.slow
def test_light_as_a_ratio_is_nearer_to_the_traced_light_than_none() -> None:
    request = Request("quick", 0, lambda: pytest.fail("no scene is needed"))
    for series in soft_light.run(request):
        exact, chosen, without = series.points
        assert [p.role for p in series.points] == ["exact", "chosen", ""] and exact.values["all"] == 0
        assert chosen.values["soft"] < without.values["soft"], series.name
