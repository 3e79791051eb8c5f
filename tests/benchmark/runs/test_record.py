import copy
import itertools
import platform
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from dummy_methods import CountMethod, FailingMethod, run

from spike4dgs.benchmark import METRICS, UserError, open_scene
from spike4dgs.benchmark.environment import harness, processor
from spike4dgs.benchmark.runs import record as records
from spike4dgs.benchmark.runs.predictions import MethodInfo
from spike4dgs.benchmark.schemas import load_schema

Record = dict[str, Any]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    from small_scenes import write_small_scene

    root = tmp_path_factory.mktemp("scenes")
    return [write_small_scene(root / str(i), seed=i) for i in range(2)]


@pytest.fixture(scope="module")
def made(scenes: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Record:
    return run(tmp_path_factory.mktemp("out"), scenes, CountMethod(), seed=5)[0]


@pytest.fixture
def record(made: Record) -> Record:
    return copy.deepcopy(made)


def test_processors_of_one_name_are_told_apart() -> None:
    facts = "processor\t: {0}\ncpu family\t: 25\nmodel\t\t: {1}\nmodel name\t: AMD EPYC\n\n"
    milan, genoa = (processor("".join(facts.format(core, model) for core in range(2))) for model in (1, 17))
    assert (milan, genoa) == ("AMD EPYC (family 25, model 1)", "AMD EPYC (family 25, model 17)")
    assert processor("CPU part\t: 0xd0c\n") == processor("") == platform.machine(), "ARM tells no name"


def test_a_record_says_what_ran_on_what(record: Record) -> None:
    assert record["schema"] == "spike4dgs-result/1"
    expected = {"name": "counts", "version": harness()["version"], "params": {"steps": 4}, "seed": 5, "trained_on": []}
    assert record["method"] == expected
    assert record["dataset"]["name"] == "pattern-0+pattern-1" and record["dataset"]["split"] == "center"
    assert set(record["dataset"]["scenes"]) == set(record["scenes"]) == {"pattern-0", "pattern-1"}
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", record["created"])
    assert {"python", "platform", "packages", "cpu", "gpu", "cuda"} == set(record["environment"])
    assert {"numpy", "torch", "scikit-image"} <= set(record["environment"]["packages"])
    for cell in record["scenes"].values():
        assert cell["status"] == "ok" and cell["error"] is None
        assert set(cell["metrics"]) == set(METRICS) and len(cell["per_image"]) == 3
        assert {"psnr", "flip", "temporal_error"} <= set(cell["computed"]) <= set(METRICS)
        assert {m for m, v in cell["metrics"].items() if v is None} <= set(cell["notes"])
        assert cell["metrics"]["niqe"] is None
        assert "3 of 3 images refused, the first cam_03/000020" in cell["notes"]["niqe"]
        assert cell["fit_seconds"] > 0 and cell["render_fps"] > 0 and cell["gain_aligned"] > 0
        assert cell["peak_memory_mb"] is None or cell["peak_memory_mb"] > 10


def test_means_are_over_scenes_and_a_missing_one_is_never_left_out(record: Record) -> None:
    values = [cell["metrics"]["psnr"] for cell in record["scenes"].values()]
    assert record["mean"]["psnr"] == pytest.approx(sum(values) / 2, abs=1e-12)
    assert records.is_complete(record)
    cells = {**record["scenes"], "pattern-1": records.missing_cell("skipped", "not run")}
    assert set(records.dataset_means(cells).values()) == {None}


def test_a_failed_scene_makes_the_mean_null_and_stays_in_the_record(scenes: list[Path], tmp_path: Path) -> None:
    record = run(tmp_path, scenes, FailingMethod("bad", ValueError("no luck")))[0]
    cell = record["scenes"]["pattern-1"]
    assert cell["status"] == "failed" and cell["error"].startswith("ValueError: no luck (see logs/bad__pattern-1.log)")
    assert cell["per_image"] == {} and set(cell["metrics"].values()) == {None}
    assert set(record["mean"].values()) == {None}
    assert not records.is_complete(record)


def change(path: str, value: Any) -> Callable[[Record], None]:
    def apply(record: Record) -> None:
        *parents, last = path.split("/")
        for key in parents:
            record = record[key]
        record[last] = value

    return apply


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (change("extra", 1), "at the top level: Additional properties are not allowed"),
        (change("method/colour", "red"), "at method: Additional properties"),
        (change("scenes/pattern-0/speed", 1), "at scenes/pattern-0: Additional properties"),
        (change("environment/host", "x"), "at environment: Additional properties"),
        (change("schema", "spike4dgs-result/2"), "expected schema 'spike4dgs-result/1'"),
        (change("created", "yesterday"), "at created"),
        (change("method/name", "../../etc"), "at method/name"),
        (change("dataset/scenes/pattern-0", "abc"), "at dataset/scenes/pattern-0"),
        (change("dataset/scenes", {"pattern-0": "0" * 64}), "expected cells for pattern-0, found pattern-0, pattern-1"),
        (change("protocol/version", 7), "expected protocol"),
        (change("mean/psnr", 99.0), "mean: expected psnr = "),
        (change("mean/psnr", None), "mean: expected psnr = "),
        (change("mean/lpips", 0.1), "unknown or missing: lpips"),
        (change("scenes/pattern-0/metrics/psnr", 99.0), "scene pattern-0: expected psnr = "),
        (change("scenes/pattern-0/metrics", {}), "unknown or missing: brisque, flip"),
        (change("scenes/pattern-0/computed/vmaf", None), "expected computed metrics of the table, found vmaf"),
        (change("scenes/pattern-0/computed", {}), "which was not computed"),
        (change("scenes/pattern-0/computed/lpips_alex", "0" * 64), "expected lpips_alex by alexnet-owt-7be5be79.pth"),
        (change("scenes/pattern-0/computed/flip", "0" * 64), "expected flip by no weights, found weights with sha256"),
        (change("scenes/pattern-0/computed/metaiqa", None), "expected metaiqa by metaiqa_resnet18.pth"),
        (change("scenes/pattern-0/notes", {}), "expected a note that says why"),
        (change("scenes/pattern-0/status", "failed"), "at scenes/pattern-0"),
        (change("scenes/pattern-0/status", "perfect"), "at scenes/pattern-0"),
        (change("scenes/pattern-0/per_image", {}), "at scenes/pattern-0/per_image"),
        (change("scenes/pattern-0/predictions_sha256", None), "at scenes/pattern-0/predictions_sha256"),
        (change("scenes/pattern-0/fit_seconds", -1.0), "at scenes/pattern-0/fit_seconds"),
        (change("scenes/pattern-0/error", "none"), "at scenes/pattern-0/error"),
    ],
)
def test_wrong_records_are_refused(record: Record, edit: Callable[[Record], None], message: str) -> None:
    edit(record)
    with pytest.raises(UserError) as e:
        records.check_record(record, "r.json")
    assert str(e.value).startswith("r.json") and message in str(e.value) and "\n" not in str(e.value)


def test_a_failed_cell_with_a_value_is_refused(record: Record) -> None:
    cell = records.missing_cell("failed", "it broke")
    record["scenes"]["pattern-0"] = {**cell, "metrics": {**cell["metrics"], "psnr": 0.0}}
    with pytest.raises(UserError, match="at scenes/pattern-0/metrics/psnr"):
        records.check_record(record, "r.json")


def test_not_a_number_is_not_written(record: Record, tmp_path: Path) -> None:
    record["method"]["params"] = {"rate": float("nan")}
    with pytest.raises(ValueError, match="Out of range float"):
        records.write_record(tmp_path / "r.json", record)
    assert not list(tmp_path.iterdir())


def test_missing_and_foreign_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"r\.json: expected a spike4dgs-result/1 record, found no such file"):
        records.read_record(tmp_path / "r.json")
    (tmp_path / "r.json").write_text("{}")
    with pytest.raises(UserError, match="expected schema 'spike4dgs-result/1', found None"):
        records.read_record(tmp_path / "r.json")


@pytest.mark.parametrize("name", ["", "a/b", "..", ".hidden", "a b", "a\n", "a\\b", "x" * 101])
def test_names_that_cannot_be_files_are_refused(name: str) -> None:
    with pytest.raises(UserError, match="method: expected a name"):
        records.check_method_name(name)


@pytest.mark.parametrize(("gain", "dark", "photons"), itertools.product((True, False), (True, False), (5e4, None)))
def test_noise_is_whole_partial_or_off(gain: bool, dark: bool, photons: float | None) -> None:
    sensor = {"model": "m", "gain_map": gain, "dark_map": dark, "photons_per_spike": photons}
    terms, meta = {gain, dark, photons is not None}, {"sensor": sensor, "source": {"kind": "mitsuba"}}
    assert records.sensor_of(meta) == ("noisy" if terms == {True} else "ideal" if terms == {False} else "partly noisy")


def test_recordings_are_recorded_and_others_say_nothing() -> None:
    sensor = {"model": "m", "rows_bottom_up": True}
    assert records.sensor_of({"sensor": sensor, "source": {"kind": "recorder"}}) == "recorded"
    assert records.sensor_of({"sensor": sensor, "source": {"kind": "dat"}}) is None


def test_records_state_the_sensor_and_older_ones_need_not(small_scene: Path, tmp_path: Path) -> None:
    record = run(tmp_path / "out", [small_scene], CountMethod())[0]
    assert record["sensors"] == {}, "the small scene does not say"
    scene = open_scene(small_scene)
    noise = {"gain_map": False, "dark_map": False, "photons_per_spike": None}
    clean = replace(scene, meta={**scene.meta, "sensor": {**scene.meta["sensor"], **noise}})
    info = MethodInfo(**{**{k: v for k, v in record["method"].items()}, "trained_on": ()})
    again = records.build_record(info, [clean], record["scenes"], "cpu")
    assert again["sensors"] == {"pattern-0": "ideal"}
    older = copy.deepcopy(again)
    del older["sensors"]
    records.check_record(older, "older")
    for wrong, message in (({"elsewhere": "ideal"}, "sensors of its scenes"), ({"pattern-0": "fine"}, "fine")):
        with pytest.raises(UserError, match=message):
            records.check_record({**again, "sensors": wrong}, "wrong")
    of_release = {"revision": "ab" * 32, "bits": 0.0}
    records.check_record({**again, "dataset": {**again["dataset"], "equivalent": {"pattern-0": of_release}}}, "right")
    with pytest.raises(UserError, match="expected equivalents of its scenes, found elsewhere"):
        dataset = {**again["dataset"], "equivalent": {"elsewhere": of_release}}
        records.check_record({**again, "dataset": dataset}, "wrong")


def test_the_schema_has_the_same_words() -> None:
    schema = load_schema("spike4dgs.benchmark", "result.schema.json")
    assert schema["properties"]["sensors"]["additionalProperties"]["enum"] == list(records.SENSORS)
