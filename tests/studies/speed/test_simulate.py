"""`speed simulate` with a substitute for spikezoo: found, run and compared like the real package."""

from __future__ import annotations

import csv

from spike4dgs.studies.speed import simulate as speed

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


def table(tmp_path, monkeypatch, source):
    package = tmp_path / "spikezoo"
    (package / "utils").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('must not be imported')")
    (package / "utils/spike_utils.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    path = tmp_path / "speed.csv"
    arguments = ["--width", "41", "--height", "25", "--ticks", "90", "--repeats", "1", "--csv", str(path)]
    assert speed.simulate(arguments) == 0
    with open(path) as f:
        return list(csv.DictReader(f))


def test_spikezoo_is_compared_from_its_own_initial_charges(tmp_path, monkeypatch):
    rows = table(tmp_path, monkeypatch, SIMULATOR)
    assert rows[-1]["simulator"] == "spikezoo video2spike_simulation" and rows[-1]["x spikezoo"] == "1"
    assert int(rows[-1]["largest count error"]) <= 1 and float(rows[-1]["pixels off, %"]) < 1
    assert all(float(row["x spikezoo"]) > 0 for row in rows)


def test_a_spikezoo_that_lacks_its_own_packages_is_not_timed(tmp_path, monkeypatch, capsys):
    rows = table(tmp_path, monkeypatch, "import a_package_that_nobody_has")
    assert rows[-1]["simulator"].endswith("not installed") and rows[-1]["ms"] == "-"
    assert "a_package_that_nobody_has" in capsys.readouterr().out
