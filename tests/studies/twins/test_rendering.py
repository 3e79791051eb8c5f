from __future__ import annotations

import pytest

from spike4dgs.studies.speed_error.measurement import Request
from spike4dgs.studies.twins.rendering import SOFT_LIGHT


@pytest.mark.slow
def test_light_as_a_ratio_is_nearer_to_the_traced_light_than_none() -> None:
    request = Request("quick", 0, "cpu", lambda: pytest.fail("no scene is needed"))
    for series in SOFT_LIGHT.run(request):
        exact, chosen, without = series.points
        assert [p.role for p in series.points] == ["exact", "chosen", ""] and exact.values["all"] == 0
        assert chosen.values["soft"] < without.values["soft"], series.name
