"""Splits: the standard ones of an array, scenes seen through them, and results that never mix."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changes import edit_json
from dummy_methods import CountMethod
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from run_command import run_benchmark
from small_scenes import HEIGHT, WIDTH, array_cameras, write_small_scene

from spike4dgs.benchmark import Budget, Target, UserError, open_scene
from spike4dgs.benchmark.runs.cell import Job
from spike4dgs.benchmark.runs.run import Settings, run_matrix
from spike4dgs.benchmark.scene.cameras import Camera, look_at
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.splits import Split, spread_order, standard_splits
from spike4dgs.benchmark.scene.writer import SceneDescription, finish_scene
from spike4dgs.cli import main
from spike4dgs.cli.submit import submit_all


def at(*positions: tuple[float, float]) -> tuple[Camera, ...]:
    """Cameras in the plane y = -5 at (x, z), looking at the origin."""
    up = np.array([0.0, 0.0, 1.0])
    return tuple(
        look_at(f"cam_{i:02d}", np.array([x, -5.0, z]), np.zeros(3), up, focal=9.0, width=8, height=6)
        for i, (x, z) in enumerate(positions)
    )


GRID = at(*((0.6 * x, 0.5 * z) for z in (1, 0, -1) for x in (-1, 0, 1)))


def names(*numbers: int) -> tuple[str, ...]:
    return tuple(f"cam_{n:02d}" for n in numbers)


def test_the_standard_splits_of_a_3x3_array() -> None:
    others = names(0, 1, 2, 3, 5, 6, 7, 8)
    assert standard_splits(GRID, "cam_04") == {
        "center": Split(others, names(4)),
        "corner": Split(names(1, 2, 3, 4, 5, 6, 7, 8), names(0)),
        "views-3": Split(names(0, 2, 8), names(4)),
        "views-4": Split(names(0, 2, 6, 8), names(4)),
        "views-5": Split(names(0, 1, 2, 6, 8), names(4)),
        "views-6": Split(names(0, 1, 2, 6, 7, 8), names(4)),
        "views-7": Split(names(0, 1, 2, 3, 6, 7, 8), names(4)),
        "views-8": Split(others, names(4)),
    }
    assert next(iter(standard_splits(GRID, "cam_04"))) == "center"


@pytest.mark.parametrize(
    ("views", "expected"),
    [
        ((4, 5), {"center": ((5,), (4,))}),
        ((3, 4, 5), {"center": ((3, 5), (4,)), "corner": ((4, 5), (3,))}),
        ((1, 4, 3, 5), {"center": ((1, 3, 5), (4,)), "corner": ((1, 4, 5), (3,)), "views-3": ((1, 3, 5), (4,))}),
    ],
)
def test_smaller_arrays_have_the_splits_that_are_possible(views: tuple[int, ...], expected: dict[str, Any]) -> None:
    found = standard_splits([GRID[v] for v in views], "cam_04")
    assert {n: (set(s.train), s.test) for n, s in found.items()} == {
        n: (set(names(*train)), names(*test)) for n, (train, test) in expected.items()
    }


@pytest.mark.parametrize("cameras", [GRID[:4], GRID[4:5], ()])
def test_no_array_around_the_held_out_camera(cameras: tuple[Camera, ...]) -> None:
    with pytest.raises(UserError, match="cameras: expected cam_04 and others, found"):
        standard_splits(cameras, "cam_04")


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3)), min_size=2, max_size=12), st.data())
def test_each_further_view_is_as_far_from_the_others_as_any(positions: list[tuple[float, float]], data: Any) -> None:
    cameras = at(*positions)
    held_out = data.draw(st.sampled_from(cameras)).id
    order = spread_order(cameras, held_out)
    assert sorted(order) == sorted(c.id for c in cameras if c.id != held_out)
    where = {c.id: np.array(c.center) for c in cameras}
    extent = max(np.linalg.norm(a - b) for a in where.values() for b in where.values()) or 1.0
    for n in range(len(order)):
        taken = order[:n] or (held_out,)
        near = {c: min(np.linalg.norm(where[c] - where[t]) for t in taken) for c in order[n:]}
        assert near[order[n]] >= max(near.values()) - 2e-6 * extent
    for name, split in standard_splits(cameras, held_out).items():
        if name.startswith("views-"):
            assert set(split.train) == set(order[: int(name[6:])]) and split.test == (held_out,)


# ---------------------------------------------------------------- scenes


@pytest.fixture(scope="module")
def one_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_scene(tmp_path_factory.mktemp("splits") / "scene", splits=True)


@pytest.fixture
def scene(one_scene: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(one_scene, tmp_path / "scene"))


def test_a_scene_is_opened_with_a_split(scene: Path) -> None:
    center, corner = open_scene(scene), open_scene(scene, split="corner")
    assert (center.split, corner.split) == ("center", "corner")
    assert center.is_default_split and not corner.is_default_split
    assert (center.train, center.test) == (names(0, 1, 2), names(3))
    assert (corner.train, corner.test) == (names(1, 2, 3), names(0))
    assert center.targets == tuple(Target("cam_03", t) for t in (20, 40, 60))
    assert corner.targets == (Target("cam_00", 30), Target("cam_00", 50))
    assert [c.id for c in corner.training.cameras] == list(names(1, 2, 3))
    assert not any("cam_00" in s.source for s in corner.training.streams)
    views = open_scene(scene, split="views-3")
    assert (views.train, views.targets) == (center.train, center.targets)
    assert center.revision == corner.revision
    for target in corner.targets:
        assert corner.ground_truth(target).shape == corner.moving(target).shape == (24, 40)


def test_the_files_say_which_images_belong_to_which_split(scene: Path, tmp_path: Path) -> None:
    targets = json.loads((scene / "targets.json").read_text())
    assert [t["tick"] for t in targets["targets"]] == [20, 40, 60]
    assert targets["splits"] == {"corner": [{"camera": "cam_00", "tick": t} for t in (30, 50)]}
    plain = write_small_scene(tmp_path / "plain")
    assert "splits" not in json.loads((plain / "targets.json").read_text())
    files = {name: scene / f"transforms_{name}.json" for name in ("train", "test", "all")}
    frames = {name: json.loads(path.read_text())["frames"] for name, path in files.items()}
    assert [f["file_path"] for f in frames["train"]] == [f"spikes/{c}.dat" for c in names(0, 1, 2)]
    test = [f["file_path"] for f in frames["test"]]
    assert test == ["spikes/cam_03.dat"] + [f"images/cam_03/0000{t}.exr" for t in (20, 40, 60)]
    everything = {f["file_path"]: f for f in frames["all"]}
    assert set(everything) == {p.relative_to(scene).as_posix() for p in (scene / "images").rglob("*.exr")}
    corner = everything["images/cam_00/000030.exr"]
    assert (corner["camera"], corner["tick"], corner["t_us"]) == ("cam_00", 30, 1500.0)
    assert corner["transform_matrix"] == frames["train"][0]["transform_matrix"]
    assert "- `corner`: train cam_01, cam_02, cam_03; test cam_00" in (scene / "README.md").read_text()


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d.pop("splits"), "expected targets of the splits corner, found none"),
        (lambda d: d["splits"].update(left=[]), "expected targets of the splits corner, found corner, left"),
        (lambda d: d["splits"].update({"views-3": []}), "found corner, views-3"),
        (lambda d: d["splits"]["corner"].append({"camera": "cam_03", "tick": 20}), "found cam_03 at tick 20"),
        (lambda d: d["splits"]["corner"].append({"camera": "cam_00", "tick": 30}), "cam_00 at tick 30 twice"),
        (lambda d: d["splits"]["corner"].append({"camera": "cam_00"}), "'tick'"),
        (lambda d: d.update(splits=[1]), "expected lists of {camera, tick}"),
    ],
)
def test_targets_that_do_not_fit_the_splits_are_refused(scene: Path, edit: Any, message: str) -> None:
    edit_json(scene / "targets.json", edit)
    write_manifest(scene)
    with pytest.raises(UserError) as e:
        open_scene(scene)
    assert "targets.json: expected" in str(e.value) and message in str(e.value)


def test_the_default_split_is_stated_once() -> None:
    cameras = array_cameras()
    description = SceneDescription(
        id="a", title="a", licence="a", cameras=cameras, train=names(0, 1), test=names(3), rate_hz=1.0, n_ticks=1,
        radiance_gain=1.0, targets=(), sensor={}, source={}, splits=standard_splits(cameras, "cam_03"),
    )  # fmt: skip
    with pytest.raises(ValueError, match="center is"):
        _ = description.all_splits


def test_cameras_of_two_sizes_become_no_scene(tmp_path: Path) -> None:
    small, large = array_cameras(1)[0], array_cameras(2, 2 * WIDTH, HEIGHT)[1]
    description = SceneDescription(
        id="a", title="a", licence="a", cameras=(small, large), train=names(0, 1), test=(), rate_hz=1.0, n_ticks=1,
        radiance_gain=1.0, targets=(), sensor={"model": "a", "rows_bottom_up": True}, source={"kind": "test"},
    )  # fmt: skip
    with pytest.raises(UserError, match="expected cameras of 40x24 pixels, found cam_01 of 80x24"):
        finish_scene(tmp_path, description)
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------- results


def run(out: Path, scene: Path, split: str | None) -> dict[str, Any]:
    with open("/dev/null", "w") as nothing:
        opened = [open_scene(scene, split=split)]
        return run_matrix(opened, [CountMethod()], Settings(out), Console(file=nothing))[0]


def test_records_and_predictions_name_their_split(scene: Path, tmp_path: Path) -> None:
    center, corner = run(tmp_path / "a", scene, None), run(tmp_path / "b", scene, "corner")
    assert (center["dataset"]["split"], corner["dataset"]["split"]) == ("center", "corner")
    assert set(corner["scenes"]["pattern-0"]["per_image"]) == {"cam_00/000030", "cam_00/000050"}
    info = json.loads((tmp_path / "b/predictions/counts/pattern-0/prediction.json").read_text())
    assert info["split"] == "corner"
    named = run(tmp_path / "c", scene, "center")
    assert named["scenes"]["pattern-0"]["metrics"] == center["scenes"]["pattern-0"]["metrics"]


def test_each_split_has_its_own_content_key(scene: Path) -> None:
    opened = [open_scene(scene, split=split) for split in ("center", "corner", "views-3")]
    assert len({Job(CountMethod(), one, 0, "cpu", Budget()).key for one in opened}) == 3


def test_other_splits_predictions_are_refused(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(tmp_path, scene, "views-3")
    folder = tmp_path / "predictions/counts/pattern-0"
    assert main(["score", str(folder), str(scene)]) == 2
    assert "expected predictions for split center, found views-3" in capsys.readouterr().err
    out = tmp_path / "r.json"
    assert main(["score", str(folder), str(scene), "--split", "views-3", "--out", str(out)]) == 0
    assert "split views-3" in capsys.readouterr().out
    assert json.loads(out.read_text())["dataset"]["split"] == "views-3"
    edit_json(folder / "prediction.json", lambda info: info.pop("split"))
    assert main(["score", str(folder), str(scene)]) == 0, "no split means the default one"
    assert main(["score", str(folder), str(scene), "--split", "views-3"]) == 2
    assert main(["score", str(folder), str(scene), "--split", "left"]) == 2
    assert "a split among center, corner, views-3, found 'left'" in capsys.readouterr().err


def test_splits_never_mix_in_a_leaderboard(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for split in ("center", "corner"):
        run(tmp_path / split, scene, split)
        predictions = tmp_path / split / "predictions/counts"
        result = tmp_path / split / "results/counts.json"
        for _ in range(2):  # the second time changes nothing
            assert not submit_all({result: predictions}, scenes=(scene,), leaderboard=tmp_path / "board")
            said = capsys.readouterr().out
            assert "counts: re-scored, place 1 of 1 by mean PSNR on the local board pattern-0 (revision " in said
    boards = json.loads((tmp_path / "board/local.json").read_text())["boards"]
    assert sorted(b["dataset"]["split"] for b in boards) == ["center", "corner"]
    assert len({b["revision"] for b in boards}) == 2
    for b in boards:
        (row,) = b["rows"]
        assert row["entries"] == [f"local/pattern-0@{b['revision'][:12]}/counts.json"]


@pytest.mark.usefixtures("no_images")
def test_run_benchmark_keeps_the_splits_apart(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("spike4dgs.cli.run_benchmark.find_methods", lambda: {"counts": CountMethod()})
    options = {"device": "cpu", "metrics": ("psnr",), "in_process": True}
    for split in (None, "corner"):
        assert run_benchmark((scene,), out=tmp_path / "out", split=split, **options) == 0
    records = {p.parent.parent.name: json.loads(p.read_text()) for p in (tmp_path / "out").rglob("results/counts.json")}
    assert {name: r["dataset"]["split"] for name, r in records.items()} == {"out": "center", "corner": "corner"}
    assert "Results, split corner" in capsys.readouterr().out
    assert (tmp_path / "out/corner/table.md").is_file()
