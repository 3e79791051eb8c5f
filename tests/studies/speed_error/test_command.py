"""The command itself: every room's measurements in the smallest size, on a small scene, to the page."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from small_scenes import write_small_scene

from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.cli import main
from spike4dgs.generators.make_dataset import SceneSettings
from spike4dgs.studies.kit.measurement import GROUPS, MS, Measurement, Point, Request, Series
from spike4dgs.studies.kit.runner import measured_from_to
from spike4dgs.studies.speed_error import command as speed_error


def measurements(fail: bool = False) -> tuple[Measurement, ...]:
    def run(request: Request) -> Iterator[Series]:
        if fail:
            raise OSError("no luck")
        yield Series(request.scene().name, (Point(request.size, {"ms": 1.0}, "chosen"),))

    return (Measurement("one", "Images from spikes", "one", "a", "b", "c", (MS,), "ms", ("ms",), run),)


def test_the_whole_command_in_its_smallest_size(small_scene: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "report"
    command = ["report", "speed-error", "--size", "tiny", "--scene", str(small_scene), "--out", str(out)]
    assert main(command) == 0
    assert f"page: {out / 'index.html'}" in capsys.readouterr().out
    report = json.loads((out / "speed_error.json").read_text())
    check_schema(report, load_schema("spike4dgs.studies.kit", "speed_error.schema.json"), "the report", "")
    ids = {m["id"] for m in report["measurements"]}
    assert {"splat", "images", "sensor", "flip", "scale-pixels"} <= ids and not ids & {"keys", "msdi"}
    groups = [m["group"] for m in report["measurements"]]
    assert groups == sorted(groups, key=GROUPS.index)
    for m in report["measurements"]:
        columns = {c["id"] for c in m["columns"]}
        assert {m["x"], *m["y"], m["cost"], m["error"]} <= columns and m["series"]
        roles = [p["role"] for s in m["series"] for p in s["points"]]
        assert ("exact" in roles and "chosen" in roles and m["reason"]) or not m["exact"], m["id"]
    html = (out / "index.html").read_text()
    assert all(f'id="{group.lower().replace(" ", "-")}"' in html for group in groups)
    capsys.readouterr()
    assert main([*command, "--only", "ssim"]) == 0
    assert "SSIM and its gradient: kept" in capsys.readouterr().out


def test_a_scene_is_made_once_and_only_when_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[tuple[object, ...]] = []
    monkeypatch.setattr(speed_error, "plan", measurements)
    monkeypatch.setattr("spike4dgs.generators.make_dataset.make_dataset", lambda *a: made.append(a) or 0)
    assert speed_error.speed_error(out=tmp_path / "a", quick=True) == 0
    assert made == [([SceneSettings("tiny", 0).job("car")], tmp_path / "a/scenes")]
    report = json.loads((tmp_path / "a/speed_error.json").read_text())
    assert report["size"] == "quick" and report["measurements"][0]["series"][0]["name"] == "car-0-tiny"
    scene = write_small_scene(tmp_path / "scene")
    assert speed_error.speed_error(out=tmp_path / "b", size="tiny", scene=scene) == 0 and len(made) == 1


def test_a_failure_is_exit_1_and_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(speed_error, "plan", lambda: measurements(fail=True))
    assert speed_error.speed_error(out=tmp_path / "a", size="tiny") == 1
    assert "failed, see the page: one" in capsys.readouterr().out
    assert "OSError: no luck" in (tmp_path / "a/index.html").read_text()


def test_what_was_measured_is_measured_again_where_that_is_asked_and_on_another_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(speed_error, "plan", measurements)
    for seed, again, kept in ((0, False, False), (0, False, True), (0, True, False), (1, False, False)):
        shutil.rmtree(tmp_path / "scene", ignore_errors=True)  # of one name, whatever is in it
        scene = write_small_scene(tmp_path / "scene", seed=seed)
        speed_error.speed_error(out=tmp_path / "a", size="tiny", scene=scene, again=again)
        assert ("one: kept" in capsys.readouterr().out) == kept


def test_the_page_says_when_kept_measurements_were_made() -> None:
    results = [
        {"measured": "2026-01-31T12:00:00Z", "seconds": 61.0},
        {"measured": "2026-01-31T13:00:10Z", "seconds": 5000.0},
    ]
    assert measured_from_to(results) == ("2026-01-31T11:36:50Z", "2026-01-31T13:00:10Z")
