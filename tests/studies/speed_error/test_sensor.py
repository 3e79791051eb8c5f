import numpy as np
import pytest

from spike4dgs.generators.sensor.model import Sensor, random_charge
from spike4dgs.generators.sensor.reference import simulate_reference
from spike4dgs.studies.kit.measurement import Request
from spike4dgs.studies.speed_error.sensor import integration, light

REQUEST = Request("tiny", 1, lambda: pytest.fail("no scene is needed"))


def test_a_count_is_off_by_one_spike_at_most_in_every_light() -> None:
    for series in integration.run(REQUEST):
        exact, *others = series.points
        assert exact.role == "exact" and exact.values["off"] == 0
        assert max(p.values["most"] for p in others if p.name.startswith("kernel")) <= 1
        assert others[-1].values["off"] < 1, series.name


def test_the_lights_are_what_their_names_say() -> None:
    keys = light(1, 12, 20, 4)
    rates = {}
    for name, images in keys.items():
        spikes = simulate_reference(images, [0, 10, 20, 30], 30, Sensor(), random_charge(12, 20, [1]))
        rates[name] = spikes.mean()
    assert rates["almost dark, 0.001"] < 0.01 < rates["a drifting pattern"] < 0.8 < rates["glaring, 10 x white"]
    assert np.ptp(keys["half of it static"][:, :, -1], axis=0).max() == 0
