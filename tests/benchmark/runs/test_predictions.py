import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from changes import edit_json, flip_bit

from spike4dgs.benchmark import Target, UserError
from spike4dgs.benchmark.files import sha256_file
from spike4dgs.benchmark.runs import predictions
from spike4dgs.benchmark.runs.predictions import (
    INFO,
    MOST_OF_IMAGE,
    SUMS,
    MethodInfo,
    PredictionInfo,
    PredictionWriter,
    open_predictions,
)

TARGETS = tuple(Target("cam_03", t) for t in (20, 40, 60, 80, 100, 120, 140))
METHOD = MethodInfo("tfp+4dgs", "1.2", {"steps": 3}, 0, ("some data",))
MADE = PredictionInfo(METHOD, "pattern-0", fit_seconds=2.5, render_fps=30.0, device="cpu")


def image(tick: int) -> np.ndarray:
    return np.random.default_rng(tick).random((24, 40)).astype(np.float32)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with PredictionWriter(tmp_path / "predictions") as writer:
        for t in TARGETS:
            writer.add(t, image(t.tick), t.tick * 50.0)
        writer.finish(MADE)
    return tmp_path / "predictions"


def test_what_is_written_is_read_back(folder: Path) -> None:
    found = open_predictions(folder, TARGETS)
    found.verify()
    assert found.info == MADE
    assert found.sha256 == sha256_file(folder / SUMS)
    for t in TARGETS:
        assert np.array_equal(found.read(t), image(t.tick).astype(np.float16))
    assert not list(folder.parent.glob(".*"))


def test_we_and_coreutils_accept_each_others_sums(folder: Path) -> None:
    done = subprocess.run(["sha256sum", "--strict", "-c", SUMS], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.count(": OK") == len(TARGETS)
    (folder / SUMS).unlink()
    subprocess.run("sha256sum */*.exr > SHA256SUMS", shell=True, cwd=folder, check=True)
    open_predictions(folder, TARGETS).verify()


def test_the_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    root = tmp_path / "p"
    with pytest.raises(RuntimeError), PredictionWriter(root) as writer:
        writer.add(TARGETS[0], image(0), 0.0)
        raise RuntimeError
    assert not list(tmp_path.iterdir())
    with PredictionWriter(root) as writer:
        writer.add(TARGETS[0], image(0), 0.0)
        assert not root.exists()
    assert not root.exists(), "a folder that was not finished must not appear"


def test_a_killed_writer_leaves_nothing_that_a_later_one_keeps(folder: Path) -> None:
    stale = folder.with_name(".predictions.part")
    shutil.copytree(folder, stale)
    with PredictionWriter(folder) as writer:
        writer.add(TARGETS[0], image(5), 0.0)
        writer.finish(replace(MADE, scene="other"))
    assert open_predictions(folder, TARGETS[:1]).info.scene == "other"
    assert not stale.exists()


def test_same_images_same_sums(folder: Path, tmp_path: Path) -> None:
    with PredictionWriter(tmp_path / "again") as writer:
        for t in reversed(TARGETS):
            writer.add(t, image(t.tick), t.tick * 50.0)
        writer.finish(replace(MADE, fit_seconds=9.0))
    assert (tmp_path / "again" / SUMS).read_bytes() == (folder / SUMS).read_bytes()


def test_missing_and_extra_predictions_are_named(folder: Path) -> None:
    with pytest.raises(UserError) as e:
        open_predictions(folder, (*TARGETS, *(Target("cam_09", t) for t in range(7))))
    first = ", ".join(f"cam_09/{t:06d}.exr" for t in range(5))
    assert f"found 7 missing: {first} and 2 more" in str(e.value)
    with pytest.raises(UserError, match=r"found 1 extra: cam_03/000140\.exr"):
        open_predictions(folder, TARGETS[:-1])
    shutil.copy(folder / "cam_03/000020.exr", folder / "cam_03/20.exr")
    with pytest.raises(UserError, match=r"found 1 extra: cam_03/20\.exr"):
        open_predictions(folder, TARGETS)
    (folder / "cam_03/20.exr").unlink()
    (folder / "cam_03/000020.exr").unlink()
    with pytest.raises(UserError, match=r"one image for each target, found 1 missing: cam_03/000020\.exr"):
        open_predictions(folder, TARGETS)


def test_a_flipped_byte_is_refused_by_name(folder: Path) -> None:
    flip_bit(folder / "cam_03/000060.exr", -5)
    found = open_predictions(folder, TARGETS)
    with pytest.raises(UserError, match=r"cam_03/000060\.exr: expected sha256"):
        found.read(TARGETS[2])
    with pytest.raises(UserError, match=r"cam_03/000060\.exr"):
        found.verify()
    found.read(TARGETS[1])


def test_an_image_that_is_too_large_is_refused_before_it_is_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(predictions, "sha256_file", lambda path: pytest.fail("read"))
    os.truncate(folder / "cam_03/000020.exr", MOST_OF_IMAGE + 1)  # a hole: it takes no room
    with pytest.raises(UserError, match=f"000020.exr: expected an image of a target, {MOST_OF_IMAGE} bytes at most"):
        open_predictions(folder, TARGETS).verify()


def test_damaged_sums_and_a_name_listed_twice_are_refused(folder: Path) -> None:
    whole = (folder / SUMS).read_text()
    twice = whole + whole.splitlines()[0] + "\n"
    for text, line in (("no hash\n", 1), ("ab  cam_03/000020.exr\n", 1), ("\n", 1), (twice, 8)):
        (folder / SUMS).write_text(text)
        with pytest.raises(UserError, match=rf"SHA256SUMS: expected lines .* found line {line}"):
            open_predictions(folder, TARGETS)


def test_missing_parts_are_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nowhere: expected a predictions folder, found no such folder"):
        open_predictions(tmp_path / "nowhere", TARGETS)
    (folder / SUMS).unlink()
    with pytest.raises(UserError, match=r"SHA256SUMS: .*no such file; write it with `sha256sum"):
        open_predictions(folder, TARGETS)
    (folder / INFO).unlink()
    with pytest.raises(UserError, match=r"prediction\.json: .*no such file"):
        open_predictions(folder, TARGETS)


def test_the_smallest_description_of_another_program_is_enough(folder: Path) -> None:
    smallest = {"schema": "spike4dgs-prediction/1", "method": {"name": "theirs"}, "scene": "pattern-0"}
    (folder / INFO).write_text(json.dumps(smallest))
    info = open_predictions(folder, TARGETS).info
    assert info == PredictionInfo(MethodInfo("theirs"), "pattern-0")


@pytest.mark.parametrize(
    ("key", "value", "found_at"),
    [
        ("scene", 3, "scene"),
        ("surprise", 1, "the top level"),
        ("fit_seconds", -1, "fit_seconds"),
        ("method", {"name": "../evil"}, "method/name"),
        ("method", {"name": "a/b"}, "method/name"),
        ("method", {}, "method"),
        ("environment", {"gpu": 1}, "environment"),
        ("schema", "other/1", "schema"),
    ],
)
def test_a_bad_description_is_refused(folder: Path, key: str, value: object, found_at: str) -> None:
    edit_json(folder / INFO, lambda info: info.update({key: value}))
    with pytest.raises(UserError, match=rf"prediction\.json: expected a valid .*prediction/1, found at {found_at}"):
        open_predictions(folder, TARGETS)


@pytest.mark.parametrize("text", ["{", "[]", '{"fit_seconds": NaN}', "\udcff"])
def test_a_damaged_description_is_refused(folder: Path, text: str) -> None:
    (folder / INFO).write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(UserError, match=r"prediction\.json: expected a spike4dgs-prediction/1"):
        open_predictions(folder, TARGETS)
