"""The table and the plot of sensors: what a camera of each sends, and what the records say."""

import csv
import io
from pathlib import Path

import numpy as np
import pytest
from dummy_methods import CountMethod, FailingMethod
from full_scene import write_full_scene
from PIL import Image
from rich.console import Console

from spike4dgs.benchmark.method import find_methods
from spike4dgs.benchmark.runs.run import Settings
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.studies.modality.command import ROWS, compare
from spike4dgs.studies.sensors import bits_per_second, sensors_of


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return open_scene(write_full_scene(tmp_path_factory.mktemp("scenes") / "full"))


def test_every_row_is_a_method_of_known_sensors() -> None:
    found = {name: sensors_of(find_methods()[name]) for name in ROWS}
    assert found == {
        **dict.fromkeys(("rgb+4dgs", "rgb+stg", "rgb-deblur+stg"), ("frames",)),
        **dict.fromkeys(("edi+stg", "edi+4dgs"), ("frames", "events")),
        **dict.fromkeys(("tfp+stg", "tfp+rig-flat+stg", "spk2img+stg", "spike4dgs", "spike4dgs-x"), ("spikes",)),
    }


def test_bits_of_a_camera(scene: Scene) -> None:
    pixels = 40 * 24
    assert bits_per_second(scene, ("spikes",)) == pixels * 20_000
    assert bits_per_second(scene, ("frames",)) == pixels * 8 * 60
    assert bits_per_second(scene, ("events",)) == pytest.approx(50 * 64 / 0.004)  # 50 events in 4 ms


def test_the_table_has_what_the_records_have(scene: Scene, tmp_path: Path) -> None:
    spikes, events = CountMethod("counts", steps=1), CountMethod("events", steps=1)
    events.given = ("poses", "frames", "events")  # type: ignore[attr-defined]
    console = Console(file=io.StringIO(), width=200)
    settings = Settings(tmp_path, metrics=("psnr",))
    rows = compare([scene], [spikes, events, FailingMethod("breaks", ValueError("no luck"))], settings, console)
    found = {row["method"]: row for row in csv.DictReader((tmp_path / "modality.csv").read_text().splitlines())}
    assert list(found) == ["counts", "events", "breaks"]
    assert float(found["counts"]["bits_per_second"]) == 40 * 24 * 20_000
    assert float(found["events"]["bits_per_second"]) == pytest.approx(40 * 24 * 480 + 800_000)
    assert found["events"]["sensors"] == "frames+events"
    for column in ("psnr", "psnr_dynamic", "temporal_error"):
        assert float(found["counts"][column]) == rows[0].summary[column]
    assert found["breaks"]["error"] and not found["breaks"]["psnr"]
    text = (tmp_path / "modality.md").read_text()
    assert "| counts | spikes | 19.2 |" in text and "| events | frames and events | 1.26 |" in text
    assert "- breaks, " in text and text in console.file.getvalue()  # type: ignore[attr-defined]
    with Image.open(tmp_path / "modality.png") as image:
        assert np.asarray(image.convert("L")).std() > 10
