"""The page's images show what was scored, and crops hold what moves; without runs they are the entries' sheets."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from submissions import edit_with_ledger, enter

from spike4dgs.benchmark.reports.error_map import SCALES
from spike4dgs.benchmark.scene.images import encode_srgb, read_exr
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.leaderboard.page.pictures import write_pictures
from spike4dgs.leaderboard.page.rows import Board, gather
from spike4dgs.leaderboard.thumbnails import sheet_path

MIDDLE, WIDTH, HEIGHT = "cam_03/000040", 40, 24  # of thumbnails


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path))


def test_images_are_those_of_the_run(finished: Path, data: Path, tmp_path: Path) -> None:
    (board,) = gather(tmp_path / "none", (finished / "out",))[0]
    said, written = list[str](), set[Path]()
    found = write_pictures(tmp_path, board, 0, data, written, said.append)
    assert not said and {p for p in tmp_path.rglob("*.webp")} == written
    assert found[0]["names"] == ["cam_03/000020", "cam_03/000040", "cam_03/000060"] and found[0]["ms"] == [1, 2, 3]
    assert sorted(board.rows[i].name for i in found[0]["rows"]) == ["out/rough", "out/tfp+4dgs"]
    scene = open_scene(data / "pattern-0")
    truth = scene.ground_truth(scene.targets[1])
    folder = tmp_path / found[0]["folder"]
    np.testing.assert_array_equal(pixels(folder / "truth/1.webp")[..., 0], encode_srgb(truth))
    number = next(i for i, r in enumerate(board.rows) if r.name == "out/rough")
    image = read_exr(finished / "out/predictions/rough/pattern-0/cam_03/000040.exr")
    np.testing.assert_array_equal(pixels(folder / f"{number}/1.webp")[..., 1], encode_srgb(image))
    levels = pixels(folder / f"{number}/1-error.webp")
    error = np.abs(image.clip(0, 1) - truth.clip(0, 1)).clip(max=0.3)
    assert (levels == levels[..., :1]).all() and error.max() > 0.01
    # A level v stands for 0.3 (v / 255)^2; half a step of it is the rounding.
    half = 0.3 * ((levels[..., 0] + 0.5) / 255) ** 2 - 0.3 * (levels[..., 0] / 255.0) ** 2
    assert (np.abs(0.3 * (levels[..., 0] / 255.0) ** 2 - error) <= half + 1e-7).all()
    assert found[0]["scales"].keys() == {*found[0]["rows"]} and {*found[0]["scales"].values()} <= {*SCALES}


def test_what_cannot_be_shown_is_said(finished: Path, data: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(finished / "out", run)
    image = run / "predictions/rough/pattern-0/cam_03/000040.exr"
    image.write_bytes(image.read_bytes() + b"x")
    (tmp_path / "some").mkdir()
    (tmp_path / "some/pattern-0").symlink_to((data / "pattern-0").resolve())
    (board,) = gather(tmp_path / "none", (run,))[0]
    said = list[str]()
    found = write_pictures(tmp_path / "out", board, 0, tmp_path / "some", set(), said.append)
    assert [board.rows[i].name for i in found[0]["rows"]] == ["run/tfp+4dgs"] and found[1] is None
    assert any("run/rough on pattern-0" in line and "sha256" in line for line in said)
    assert any("no images of pattern-1" in line for line in said)


def test_a_scene_whose_images_are_all_others_shows_thumbnails(done: Path, data: Path, tmp_path: Path) -> None:
    enter(done)
    for name in ("tfp+4dgs", "rough"):
        (done / f"out/predictions/{name}/pattern-0/SHA256SUMS").unlink()
    (board,) = gather(done / "board", (done / "out",))[0]
    said = list[str]()
    first, second = write_pictures(tmp_path, board, 0, data, set(), said.append)
    assert "sheets" in first and "folder" in second and len(said) == 2


def shown(done: Path, out: Path) -> tuple[Board, list[Any], list[str]]:
    """The page's board of the entries alone, its pictures, and what is not shown."""
    (board,) = gather(done / "board", ())[0]
    said = list[str]()
    return board, write_pictures(out, board, 0, done / "none", set(), said.append), said


def test_thumbnails_on_the_page_are_the_sheets_themselves(done: Path, tmp_path: Path) -> None:
    paths = {name: enter(done, name) for name in ("tfp+4dgs", "rough")}
    board, pictures, said = shown(done, tmp_path / "page")
    assert not said and [p["names"] for p in pictures] == [[MIDDLE], [MIDDLE]]
    for i, row in enumerate(board.rows):
        for s, of in enumerate(pictures):
            place = of["sheets"][i]
            assert (tmp_path / "page" / place["file"]).read_bytes() == sheet_path(paths[row.name]).read_bytes()
            assert (place["top"], place["width"], place["height"]) == (s * HEIGHT, 3 * WIDTH, 2 * HEIGHT)
            assert list(of["crops"][0]) == row.thumbnails["scenes"][f"pattern-{s}"]["crop"]
    assert len(list((tmp_path / "page").rglob("*.webp"))) == 2


def test_the_images_of_a_run_stand_alone(done: Path, data: Path, tmp_path: Path) -> None:
    enter(done, "rough")
    (board,) = gather(done / "board", (done / "out",))[0]
    pictures = write_pictures(tmp_path, board, 0, data, set(), list[str]().append)
    assert all("sheets" not in of and len(of["names"]) == 3 for of in pictures)
    pictures = write_pictures(tmp_path, board, 0, done / "none", set(), list[str]().append)
    assert [[board.rows[i].name for i in of["rows"]] for of in pictures] == [["rough"], ["rough"]], "without scenes"


def test_a_row_of_another_target_is_left_out(done: Path, tmp_path: Path) -> None:
    enter(done)
    path = enter(done, "rough")
    edit_with_ledger(path, lambda e: e["thumbnails"]["scenes"]["pattern-1"].update(target="cam_03/000020"))
    board, pictures, said = shown(done, tmp_path)
    assert len(pictures[0]["rows"]) == 2 and [board.rows[i].name for i in pictures[1]["rows"]] == [board.rows[0].name]
    assert len(said) == 1 and "on pattern-1: of another target or size" in said[0]


def test_an_exchanged_sheet_is_not_shown(done: Path, tmp_path: Path) -> None:
    path, other = enter(done), enter(done, "rough")
    sheet_path(path).write_bytes(sheet_path(other).read_bytes())
    board, pictures, said = shown(done, tmp_path / "page")
    assert [[board.rows[i].name for i in of["rows"]] for of in pictures] == [["rough"], ["rough"]]
    assert len(said) == 1 and said[0].startswith(f"no thumbnails of tfp+4dgs: {sheet_path(path)}: expected sha256")
    assert len(list((tmp_path / "page").rglob("*.webp"))) == 1
