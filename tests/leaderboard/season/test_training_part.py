from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from changes import files_in, flip_bit
from made_season import Made

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import sha256_file
from spike4dgs.benchmark.metrics.measure import select_metrics
from spike4dgs.benchmark.runs.apart.training_part import training_files, write_training_part
from spike4dgs.benchmark.runs.cell import Job
from spike4dgs.benchmark.runs.held_out import has_truth
from spike4dgs.benchmark.runs.score import open_for, score_scene
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.leaderboard.season.season_file import OPENING_NAME, read_opening
from spike4dgs.leaderboard.season.secret_folder import pack_scene, scene_folder, training_folder

SCENE = "car-9003-tiny"
DESCRIPTIONS = ("scene.json", "manifest.json", "targets.json", "croissant.json", "README.md")


@pytest.fixture
def whole(once: Made) -> Scene:
    return open_scene(scene_folder(once.secret, SCENE))


@pytest.fixture
def part(once: Made) -> Scene:
    return open_scene(training_folder(once.secret, SCENE))


def test_no_byte_of_the_truth_is_in_it(whole: Scene, part: Scene) -> None:
    """Files are a training camera's recordings, byte for byte, or descriptions; no other file's bytes are anywhere."""
    inside, outside = files_in(part.root), files_in(whole.root)
    recordings = {name for name in inside if name in outside and inside[name] == outside[name]}
    allowed = {n for n in outside if any(f"/{c}." in n for c in whole.train) and not n.startswith("truth/")}
    assert {n for n in recordings if not n.startswith(("sparse/", "transforms_"))} == allowed
    rest = {n for n in inside if n not in recordings and not n.startswith(("transforms_", "sparse/0/"))}
    assert rest <= set(DESCRIPTIONS)
    everything = b"".join(inside.values())
    kept_back = {n: d for n, d in outside.items() if n not in inside and len(d) > 100}
    assert {n.split("/")[0] for n in kept_back} >= {"images", "masks", "geometry", "truth", "spikes", "events"}
    for name, data in kept_back.items():
        assert data not in everything, name
        assert hashlib.sha256(data).hexdigest().encode() not in everything, f"not even the hash of {name}"


def test_the_seed_is_not_in_it(once: Made, part: Scene) -> None:
    drawn = read_opening(once.secret / OPENING_NAME)
    everything = b"".join(files_in(training_folder(once.secret, SCENE)).values())
    for seed in drawn.scenes:
        assert seed.seed.encode() not in everything
        for order in ("little", "big"):
            assert int(seed.seed).to_bytes(16, order) not in everything  # type: ignore[arg-type]
    assert "seed" not in part.meta["source"] and "notes" not in part.meta["source"]
    assert (part.meta["source"]["world"], part.meta["source"]["variant"]) == ("car", 9003)


def test_a_method_gets_the_same_from_it(whole: Scene, part: Scene) -> None:
    a, b = whole.training, part.training
    assert [c.id for c in a.cameras] == [c.id for c in b.cameras]
    for x, y in zip(a.cameras, b.cameras, strict=True):
        np.testing.assert_allclose(x.K, y.K)
        np.testing.assert_allclose(x.R, y.R, atol=1e-12)
        np.testing.assert_allclose(x.t, y.t, atol=1e-12)
    for s, t in zip(a.streams, b.streams, strict=True):
        assert s.packed.tobytes() == t.packed.tobytes()
    for r, q in zip(a.recordings, b.recordings, strict=True):
        assert r and q and r.flat.packed.tobytes() == q.flat.packed.tobytes()
    assert part.targets == whole.targets and part.test == whole.test
    assert a.events("cam_00").events.t.tolist() == b.events("cam_00").events.t.tolist()


def test_what_is_kept_back_is_a_clear_error(part: Scene) -> None:
    assert not has_truth(part)
    with pytest.raises(UserError, match="expected a stream of cam_04, found none"):
        part.stream("cam_04")
    with pytest.raises(UserError, match="images/cam_04/000020.exr"):
        part.ground_truth(part.targets[0])
    with pytest.raises(UserError, match="expected a split among center"):
        open_scene(part.root, split="corner")


def test_predictions_of_it_are_scored_without_truth(once: Made, part: Scene) -> None:
    folder = once.root / "runs/predictions/counts" / SCENE
    cell = score_scene(open_for(folder, part), part, select_metrics(("psnr", "ssim", "brisque")))
    assert cell["metrics"]["psnr"] is None and cell["metrics"]["brisque"] is not None


def test_refinement_needs_the_held_out_stream(whole: Scene, part: Scene) -> None:
    class Refining:
        name, params, refines_views = "m", {}, True

    names = [[i.name for i in Job(Refining(), s, 0, "cpu", None).variants] for s in (whole, part)]  # type: ignore[arg-type]
    assert names == [["m", "m.refined"], ["m"]]


def test_equal_scenes_have_equal_parts_and_others_do_not(whole: Scene, part: Scene, tmp_path: Path) -> None:
    again = write_training_part(whole, tmp_path / SCENE)
    assert files_in(again.root) == files_in(part.root)
    copy = Path(shutil.copytree(whole.root, tmp_path / "changed"))
    flip_bit(copy / "spikes/cam_00.dat", 100)
    write_manifest(copy)
    assert write_training_part(open_scene(copy), tmp_path / "other").revision != part.revision


def test_other_sensors_of_training_cameras_are_in_it(made: Made) -> None:
    whole = open_scene(scene_folder(made.secret, SCENE))
    for camera in ("cam_00", "cam_04"):
        for name in (f"conventional/{camera}/000000.png", f"calibration/maps/{camera}.npz"):
            (whole.root / name).parent.mkdir(parents=True, exist_ok=True)
            (whole.root / name).write_bytes(b"0")
    write_manifest(whole.root)
    names = training_files(open_scene(whole.root))
    assert "conventional/cam_00/000000.png" in names and "conventional/cam_04/000000.png" not in names
    assert {n.split("/")[0] for n in names} == {"spikes", "calibration", "conventional", "events"}


def test_a_name_that_begins_like_a_training_cameras_is_another() -> None:
    names = ("spikes/cam.dat", "spikes/cam.1.dat", "calibration/flat/cam.npz", "calibration/flat/cam.1.npz")
    names += ("events/cam.npz", "events/cam.1.npz", "conventional/cam/000010.exr", "conventional/cam.1/000010.exr")
    scene = SimpleNamespace(train=("cam",), manifest=SimpleNamespace(files=dict.fromkeys(names)))
    assert training_files(cast(Scene, scene)) == sorted(name for name in names if "cam.1" not in name)


def test_a_pack_unpacks_to_the_scene(small_scene: Path, tmp_path: Path) -> None:
    scene = open_scene(small_scene)
    digest = pack_scene(scene, tmp_path / "s.tar")
    assert digest == sha256_file(tmp_path / "s.tar")
    subprocess.run(["tar", "xf", "s.tar"], cwd=tmp_path, check=True)
    assert files_in(tmp_path / scene.id) == files_in(small_scene)


def test_equal_scenes_have_equal_packs(small_scene: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(small_scene, tmp_path / "copy"))
    for path in copy.rglob("*"):
        os.utime(path, (1, 1))
        path.chmod(0o700)
    (copy / ".hidden").write_text("not of the scene")
    packs = [pack_scene(open_scene(root), tmp_path / f"{root.name}.tar") for root in (small_scene, copy)]
    assert packs[0] == packs[1]


def test_a_damaged_file_is_not_packed(small_scene: Path, tmp_path: Path) -> None:
    scene = open_scene(small_scene)
    (small_scene / "spikes/cam_01.dat").write_bytes(b"1")
    with pytest.raises(UserError, match="cam_01.dat"):
        pack_scene(scene, tmp_path / "s.tar")
    assert not (tmp_path / "s.tar").exists()
