from dataclasses import replace

import pytest

from spike4dgs.generators.profiles import PROFILES
from spike4dgs.generators.rendering.mitsuba_variant import load_mitsuba
from spike4dgs.studies.kit.measurement import Request
from spike4dgs.studies.speed_error import rendering
from spike4dgs.studies.speed_error.rendering import soft_light, split_light

REQUEST = Request("tiny", 0, lambda: pytest.fail("no scene is needed"))


@pytest.fixture(autouse=True)
def _one_world(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the size whose times are of one image each; a quarter of the background's samples give the same errors."""
    monkeypatch.setitem(rendering.OF_SIZE, "tiny", ("car",))
    monkeypatch.setattr(rendering, "PROFILES", {"tiny": replace(PROFILES["tiny"], background_spp=64)})


@pytest.mark.slow
def test_light_as_a_ratio_is_nearer_to_the_traced_light_than_none() -> None:
    for series in soft_light.run(REQUEST):
        exact, chosen, without = series.points
        assert [p.role for p in series.points] == ["exact", "chosen", ""] and exact.values["all"] == 0
        assert chosen.values["soft"] < without.values["soft"], series.name


@pytest.mark.slow
def test_maps_of_soft_light_have_less_noise_than_paths_and_the_same_light() -> None:
    if load_mitsuba().variant().startswith("scalar"):
        pytest.skip("maps need a variant that compiles kernels")
    for series in split_light.run(REQUEST):
        paths, exact, maps, truth = series.points
        assert [p.role for p in series.points] == ["", "exact", "chosen", ""] and exact.values["paths"] is None
        for key in ("noise", "object"):
            assert paths.values[key] + 4 < maps.values[key] < truth.values[key], series.name  # measured: 5.3 and 7 dB
        assert min(maps.values["paths"], truth.values["paths"]) > 36
