"""Packing, against tarfile, sha256sum and the grouping rule of WebDataset."""

import hashlib
import itertools
import json
import re
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest
from changes import files_in, flip_bit, leave_part

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import locked, read_json
from spike4dgs.benchmark.release import shard as shard_module
from spike4dgs.benchmark.release.index import BLOCK, Release, camera_of, member_name, read_release
from spike4dgs.benchmark.release.pack import SUMS, counted_copy, pack
from spike4dgs.benchmark.scene.scene import open_scene, open_scenes
from spike4dgs.benchmark.scene.verify import verify_content
from spike4dgs.cli import main
from spike4dgs.cli.verify import verify
from spike4dgs.generators.recorder.sources import DARK, emulated_source


def lists(root: Path) -> list[dict]:
    """The lists of all shards."""
    return [json.loads(path.read_text()) for path in sorted(root.glob("shards/*/*.json"))]


def test_the_index_says_where_every_file_lies(release_folder: Path, scene_folders: tuple[Path, ...]) -> None:
    seen = {}
    for described in lists(release_folder):
        data = (release_folder / described["shard"]).read_bytes()
        assert hashlib.sha256(data).hexdigest() == described["sha256"]
        with tarfile.open(release_folder / described["shard"]) as tar:
            members = [(m.name, m.offset_data, m.size) for m in tar]
        assert members == [(f["name"], f["offset"], f["bytes"]) for f in described["files"]]
        for f in described["files"]:
            own = data[f["offset"] : f["offset"] + f["bytes"]]
            assert hashlib.sha256(own).hexdigest() == f["sha256"]
            blocks = [own[i : i + BLOCK] for i in range(0, len(own), BLOCK)] or [b""]
            assert [hashlib.sha256(b).hexdigest() for b in blocks] == f["blocks"]
            seen[f"{f['scene']}/{f['path']}"] = own
    for root in scene_folders:
        for path in open_scene(root).manifest.files:
            if not path.startswith("calibration/") and path != "croissant.json":
                assert seen[f"{root.name}/{path}"] == (root / path).read_bytes(), "files are in it verbatim"
    assert any(path.endswith("spikes/cam_00.dat") for path in seen)


def test_a_sample_of_webdataset_is_a_camera(release_folder: Path) -> None:
    """Samples are neighbours whose names agree up to the first dot of the base name (webdataset's `base_plus_ext`)."""
    keys = []
    for described in lists(release_folder):
        names = [f["name"] for f in described["files"]]
        found = [re.match(r"^((?:.*/|)[^.]+)[.]([^/]*)$", name) for name in names]
        keys += [key for key, _ in itertools.groupby(m[1] for m in found if m)]
        assert all(found)
    cameras = [f"cam_{i:02d}" for i in range(4)]
    assert keys == [f"pattern-{s}/{sample}" for s in (0, 1) for sample in ("scene", *cameras)], "none is cut in two"


def test_shards_are_no_longer_than_asked(release: Release) -> None:
    assert len(release.shards) > 2
    assert all(shard.bytes <= 6_000_000 for shard in release.shards)


def test_recordings_are_counted_in_the_same_scene(
    release_folder: Path, release: Release, scene_folders: tuple[Path, ...], tmp_path: Path
) -> None:
    assert main(["download", "all", "--from", str(release_folder), "--out", str(tmp_path)]) == 0
    raw, counted = open_scene(scene_folders[0]), open_scene(tmp_path / "pattern-0")
    assert {p.suffix for p in (counted.root / "calibration").rglob("*.*")} == {".npz"}
    assert counted.revision == raw.revision == release.scenes["pattern-0"].revision
    assert not (release_folder / ".counted").exists()


def test_equal_scenes_give_equal_bytes(release_folder: Path, scene_folders: tuple[Path, ...], tmp_path: Path) -> None:
    pack(open_scenes(scene_folders), tmp_path / "again", "1", 6_000_000)
    assert files_in(tmp_path / "again") == files_in(release_folder)


def test_sums_are_those_of_sha256sum(release_folder: Path) -> None:
    done = subprocess.run(["sha256sum", "--strict", "-c", SUMS], cwd=release_folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    listed = {line.split("  ")[1] for line in (release_folder / SUMS).read_text().splitlines()}
    assert set(files_in(release_folder)) - {SUMS} == listed


def test_a_killed_run_goes_on(release_folder: Path, scene_folders: tuple[Path, ...], tmp_path: Path) -> None:
    code = (
        "import os, signal, sys; from pathlib import Path\n"
        "from spike4dgs.benchmark.release import pack, shard\n"
        "from spike4dgs.benchmark.scene.scene import open_scenes\n"
        "write, n = shard.write_shard, [0]\n"
        "def killed(*arguments):\n"
        "    n[0] += 1\n"
        "    if n[0] == 3: os.kill(os.getpid(), signal.SIGKILL)\n"
        "    return write(*arguments)\n"
        "pack.write_shard = killed\n"
        "pack.pack(open_scenes([Path(p) for p in sys.argv[2:]]), Path(sys.argv[1]), '1', 6_000_000)\n"
    )
    out = tmp_path / "out"
    done = subprocess.run([sys.executable, "-c", code, str(out), *map(str, scene_folders)], capture_output=True)
    assert done.returncode == -9
    leave_part(out / "shards/000")
    assert not (out / "release.json").exists()
    kept = sorted(out.glob("shards/*/*.tar"))
    times = [path.stat().st_mtime_ns for path in kept]
    damaged = kept.pop()
    times.pop()
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"x")
    pack(open_scenes(scene_folders), out, "1", 6_000_000)
    assert files_in(out) == files_in(release_folder)
    assert len(kept) == 1 and [path.stat().st_mtime_ns for path in kept] == times, "a finished shard stays"


def test_a_damaged_scene_is_not_packed(scene_folders: tuple[Path, ...], tmp_path: Path) -> None:
    root = Path(shutil.copytree(scene_folders[1], tmp_path / "pattern-1"))
    flip_bit(root / "spikes/cam_02.dat", 1000)
    with pytest.raises(UserError, match=r"cam_02.dat: expected .* sha256 .*, found .*; the file was changed"):
        pack([open_scene(root)], tmp_path / "out", "1", 6_000_000)
    assert not list((tmp_path / "out").rglob("*.part*"))


def test_what_is_there_is_not_overwritten(scene_folders: tuple[Path, ...], tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="found notes.txt; choose another --out"):
        pack(open_scenes(scene_folders), tmp_path, "1", 6_000_000)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    with pytest.raises(UserError, match="expected scenes of different ids, found pattern-0 twice"):
        pack(open_scenes([scene_folders[0]] * 2), tmp_path / "new", "1", 6_000_000)


def test_a_camera_larger_than_a_shard_has_its_own(scene_folders: tuple[Path, ...], tmp_path: Path) -> None:
    release = pack([open_scene(scene_folders[1])], tmp_path / "out", "1", 1_000_000)
    assert [s.camera for s in release.scenes["pattern-1"].samples] == [None, *(f"cam_{i:02d}" for i in range(4))]
    assert [s.shard for s in release.scenes["pattern-1"].samples] == list(range(5))
    assert read_release(tmp_path / "out") == release


def test_sizes_of_tars_that_need_more_than_the_classic_header() -> None:
    """Of names beyond 100 characters and files beyond 8 GiB, a header is as tarfile itself writes it."""
    long = shard_module.PlannedFile(f"s/{'x' * 150}.dat", "s", "x", None, Path("x"), 10_000_000_001, "0" * 64)
    info = tarfile.TarInfo(long.name)
    info.size, info.mode = long.bytes, 0o644
    header = len(info.tobuf(tarfile.GNU_FORMAT))
    assert header > 512
    assert long.packed_bytes == header + -(-long.bytes // 512) * 512


def size(root: Path) -> int:
    return sum(p.stat().st_size for p in root.rglob("*") if p.is_file())


def test_a_copy_is_smaller_and_the_same_scene(one_full_scene: Path, tmp_path: Path) -> None:
    scene = open_scene(one_full_scene, split="corner")
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


def test_a_copy_is_whole_or_absent(full_scene: Path, tmp_path: Path) -> None:
    scene = open_scene(full_scene)
    (scene.root / "calibration/dark/cam_03.dat").write_bytes(b"cut off")
    with pytest.raises(UserError, match="cam_03.dat"):
        counted_copy(scene, tmp_path / "copy")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene"]
    with pytest.raises(UserError, match="a new or empty folder"):
        counted_copy(scene, scene.root)


def test_an_emulated_array_needs_the_raw_recordings(one_full_scene: Path, tmp_path: Path) -> None:
    copy = counted_copy(open_scene(one_full_scene), tmp_path / "copy")
    with pytest.raises(UserError, match=r"cam_00.npz: expected a raw recording \(.dat\), found a counted one"):
        emulated_source(copy.root, None, DARK)


def test_files_belong_to_the_camera_whose_whole_name_they_bear() -> None:
    cameras = ("cam", "cam.0", "cam_00.raw")
    assert [camera_of(f"spikes/{camera}.dat", cameras) for camera in cameras] == list(cameras)
    paths = ("images/cam.0/000020.exr", "scene.json", "sparse/0/cameras.bin")
    assert [camera_of(path, cameras) for path in paths] == ["cam.0", None, None]
    named = ("0", "images", "flat")  # as folders are that belong to no camera
    paths = ("sparse/0/images.bin", "images/0/20.exr", "images/images/20.exr", "calibration/flat/0.dat", "flat.json")
    assert [camera_of(path, named) for path in paths] == [None, "0", "images", "0", None]
    assert member_name("s", "images/images/20.exr", "images") == "s/images.images.20.exr"


def test_the_working_folder(scene_folders: tuple[Path, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    pack(open_scenes(scene_folders), Path("."), "1", 6_000_000)
    assert (tmp_path / "release.json").is_file()


def test_two_programs_do_not_pack_into_one_folder(scene_folders: tuple[Path, ...], tmp_path: Path) -> None:
    message = "expected a folder that no other program packs into, found a run in progress"
    with locked(tmp_path / ".1.lock", "x", "free"), pytest.raises(UserError, match=message):
        pack(open_scenes(scene_folders), tmp_path / "1", "1", 6_000_000)
    assert not (tmp_path / "1").exists()
