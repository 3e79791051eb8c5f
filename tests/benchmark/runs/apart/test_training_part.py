"""The part of a scene that one fit sees: what the method is given, and no more."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from changes import files_in
from release_scenes import write_release_scenes
from small_scenes import write_small_scene

from spike4dgs.benchmark.method import GIVEN
from spike4dgs.benchmark.runs.apart import training_part
from spike4dgs.benchmark.runs.apart.training_part import write_nameless_part
from spike4dgs.benchmark.scene.scene import Scene, open_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A scene with recordings of light and darkness for all its cameras; cam_03 is held out."""
    return open_scene(write_release_scenes(tmp_path_factory.mktemp("scenes"))[0])


def recordings(part: Scene) -> set[str]:
    return {name for name in part.manifest.files if name.startswith(("spikes/", "calibration/"))}


def test_recordings_are_those_that_the_method_is_given(scene: Scene, tmp_path: Path) -> None:
    streams = {f"spikes/cam_0{i}.dat" for i in range(3)}
    light = {f"calibration/{kind}/cam_0{i}.dat" for kind in ("flat", "dark") for i in range(3)}
    for given, expected in (((), streams), (("flat-field",), streams | light), (GIVEN, streams | light)):
        part = write_nameless_part(scene, tmp_path / "part", given)
        assert recordings(part) == expected and not list(part.manifest.problems())
        found = part.training
        for mine, whole in zip(found.streams, scene.training.streams, strict=True):
            assert mine.packed.tobytes() == whole.packed.tobytes()
        assert [r is not None for r in found.recordings] == [bool(expected - streams)] * 3
        for camera in part.train:
            assert (part.root / f"spikes/{camera}.dat").stat().st_nlink == 1, "a fit cannot write into the scene"


def test_other_splits_have_the_streams_of_their_own_training_cameras(tmp_path: Path) -> None:
    root = write_small_scene(tmp_path / "scene", splits=True)
    for split, held_out in (("corner", "cam_00"), ("views-3", "cam_03")):
        opened = open_scene(root, split=split)
        part = write_nameless_part(opened, tmp_path / split, ())
        assert recordings(part) == {f"spikes/{camera}.dat" for camera in opened.train}
        assert part.train == opened.train and part.test == (held_out,)


def test_points_are_there_for_those_that_are_given_points(scene: Scene, tmp_path: Path) -> None:
    def points(root: Path) -> Any:
        model = pycolmap.Reconstruction(str(root / "sparse/0"))
        return np.array(sorted(p.xyz.tolist() for p in model.points3D.values()))

    before = files_in(scene.root)
    assert points(write_nameless_part(scene, tmp_path / "a", ("poses", "points")).root).shape == (30, 3)
    np.testing.assert_array_equal(points(tmp_path / "a"), points(scene.root))
    assert not len(points(write_nameless_part(scene, tmp_path / "b", ("poses",)).root))
    assert files_in(scene.root) == before, "no link was written through"


def test_disks_without_links_get_copies(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any, **kwargs: Any) -> None:
        raise OSError("no links here")

    monkeypatch.setattr(training_part, "_MOST_COPIED", 0)
    part = write_nameless_part(scene, tmp_path / "linked", GIVEN)
    assert os.path.samefile(part.root / "spikes/cam_00.dat", scene.root / "spikes/cam_00.dat")
    linked = files_in(part.root)
    monkeypatch.setattr(os, "link", refuse)
    part = write_nameless_part(scene, tmp_path / "copied", GIVEN)
    assert files_in(part.root) == linked
    assert (part.root / "spikes/cam_00.dat").stat().st_nlink == 1
