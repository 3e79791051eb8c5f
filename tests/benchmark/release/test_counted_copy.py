from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from full_scene import write_full_scene

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import read_json
from spike4dgs.benchmark.release.pack import counted_copy
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.scene.verify import verify_content
from spike4dgs.cli.verify import verify
from spike4dgs.generators.recorder.sources import DARK, emulated_source


def size(root: Path) -> int:
    return sum(p.stat().st_size for p in root.rglob("*") if p.is_file())


def test_a_copy_is_smaller_and_the_same_scene(tmp_path: Path) -> None:
    scene = open_scene(write_full_scene(tmp_path / "scene"), split="corner")
    copy = counted_copy(scene, tmp_path / "copies" / "scene")
    assert copy.revision == scene.revision and copy.split == "corner"
    assert size(copy.root / "calibration") < size(scene.root / "calibration") / 2
    assert {p.suffix for p in (copy.root / "calibration").rglob("*.*")} == {".npz"}
    assert list(verify_content(copy)) == [] and verify((copy.root,)) == 0
    for mine, theirs in zip(copy.training.calibrations or (), scene.training.calibrations or (), strict=True):
        np.testing.assert_array_equal(mine.gain, theirs.gain)
        np.testing.assert_array_equal(mine.dark, theirs.dark)
        assert mine.radiance_gain == theirs.radiance_gain
    sets = {part["@id"]: part.get("includes") for part in read_json(copy.root / "croissant.json", "x")["distribution"]}
    assert sets["calibration-flat-counts-files"] == "calibration/flat/*.npz" and "calibration-flat-files" not in sets
    again = counted_copy(copy, tmp_path / "again")
    assert size(again.root) == size(copy.root) and again.revision == scene.revision


def test_a_copy_is_whole_or_absent(tmp_path: Path) -> None:
    scene = open_scene(write_full_scene(tmp_path / "scene"))
    (scene.root / "calibration/dark/cam_03.dat").write_bytes(b"cut off")
    with pytest.raises(UserError, match="cam_03.dat"):
        counted_copy(scene, tmp_path / "copy")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene"]
    with pytest.raises(UserError, match="a new or empty folder"):
        counted_copy(scene, scene.root)


def test_an_emulated_array_needs_the_raw_recordings(tmp_path: Path) -> None:
    copy = counted_copy(open_scene(write_full_scene(tmp_path / "scene")), tmp_path / "copy")
    with pytest.raises(UserError, match=r"cam_00.npz: expected a raw recording \(.dat\), found a counted one"):
        emulated_source(copy.root, None, DARK)
