from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from spike4dgs.generators.sensor.model import Sensor, random_charge
from spike4dgs.generators.sensor.reference import simulate_reference
from spike4dgs.studies.kit.measurement import Request, Series
from spike4dgs.studies.speed_error.sensor import integration, light, other_program

REQUEST = Request("tiny", 1, "cpu", lambda: pytest.fail("no scene is needed"))


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


SIMULATOR = """
import numpy as np

def video2spike_simulation(imgs, threshold=2.0):
    charge = np.random.random(imgs[0].shape) * threshold
    spikes = np.zeros(imgs.shape, np.uint8)
    for tick, image in enumerate(imgs):
        charge += image
        spikes[tick] = charge >= threshold
        charge[spikes[tick] == 1] -= threshold
    return spikes
"""


def spikezoo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str) -> list[Series]:
    """The comparison with a substitute for spikezoo: found and run without the package itself."""
    (tmp_path / "spikezoo/utils").mkdir(parents=True)
    (tmp_path / "spikezoo/__init__.py").write_text("raise RuntimeError('must not be imported')")
    (tmp_path / "spikezoo/utils/spike_utils.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    return list(other_program.run(REQUEST))


def test_spikezoo_is_compared_from_its_own_initial_charges(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (series,) = spikezoo(tmp_path, monkeypatch, SIMULATOR)
    assert [p.name for p in series.points][1] == "spikezoo" and series.points[-1].role == "chosen"
    for p in series.points:
        assert p.values["ms"] > 0 and p.values["most"] <= 1 and p.values["off"] < 1


def test_a_spikezoo_that_lacks_its_own_packages_is_not_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ImportError, match="a_package_that_nobody_has"):
        spikezoo(tmp_path, monkeypatch, "import a_package_that_nobody_has")
