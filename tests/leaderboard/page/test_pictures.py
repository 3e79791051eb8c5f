"""The page's images show what was scored, and crops hold what moves."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from PIL import Image

from spike4dgs.benchmark.scene.images import encode_srgb, read_exr
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.leaderboard.page.pictures import write_pictures
from spike4dgs.leaderboard.page.rows import gather


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
    assert set(found[0]["scales"]) == set(found[0]["rows"]) and set(found[0]["scales"].values()) <= {
        0.3,
        0.1,
        0.03,
        0.01,
    }


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
