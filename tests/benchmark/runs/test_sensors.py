"""The sensor of a scene in one word, in scene.json and in records."""

from __future__ import annotations

import copy
import itertools
from dataclasses import replace
from pathlib import Path

import pytest
from dummy_methods import CountMethod, run

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.runs.predictions import MethodInfo
from spike4dgs.benchmark.runs.record import SENSORS, build_record, check_record, sensor_of
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.schemas import load_schema


@pytest.mark.parametrize(("gain", "dark", "photons"), itertools.product((True, False), (True, False), (5e4, None)))
def test_noise_is_whole_partial_or_off(gain: bool, dark: bool, photons: float | None) -> None:
    meta = {
        "sensor": {"model": "m", "gain_map": gain, "dark_map": dark, "photons_per_spike": photons},
        "source": {"kind": "mitsuba"},
    }
    terms = {gain, dark, photons is not None}
    assert sensor_of(meta) == ("noisy" if terms == {True} else "ideal" if terms == {False} else "partly noisy")


def test_recordings_are_recorded_and_others_say_nothing() -> None:
    sensor = {"model": "m", "rows_bottom_up": True}
    assert sensor_of({"sensor": sensor, "source": {"kind": "recorder"}}) == "recorded"
    assert sensor_of({"sensor": sensor, "source": {"kind": "dat"}}) is None


def test_records_state_the_sensor_and_older_ones_need_not(small_scene: Path, tmp_path: Path) -> None:
    record = run(tmp_path / "out", [small_scene], CountMethod())[0]
    assert record["sensors"] == {}, "the small scene does not say"
    scene = open_scene(small_scene)
    noise = {"gain_map": False, "dark_map": False, "photons_per_spike": None}
    clean = replace(scene, meta={**scene.meta, "sensor": {**scene.meta["sensor"], **noise}})
    info = MethodInfo(**{**{k: v for k, v in record["method"].items()}, "trained_on": ()})
    again = build_record(info, [clean], record["scenes"], "cpu")
    assert again["sensors"] == {"pattern-0": "ideal"}
    older = copy.deepcopy(again)
    del older["sensors"]
    check_record(older, "older")
    for wrong, message in (({"elsewhere": "ideal"}, "sensors of its scenes"), ({"pattern-0": "fine"}, "fine")):
        with pytest.raises(UserError, match=message):
            check_record({**again, "sensors": wrong}, "wrong")


def test_the_schema_has_the_same_words() -> None:
    schema = load_schema("spike4dgs.benchmark", "result.schema.json")
    assert schema["properties"]["sensors"]["additionalProperties"]["enum"] == list(SENSORS)
