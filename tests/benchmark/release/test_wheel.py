"""Wheels of releases: pip installs them, and their scenes open."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from changes import files_in

from spike4dgs.benchmark import UserError, open_scene
from spike4dgs.benchmark.release import wheel
from spike4dgs.benchmark.release.fingerprint import compare, read_fingerprint
from spike4dgs.benchmark.release.index import Release
from spike4dgs.benchmark.release.wheel import write_wheel
from spike4dgs.cli import main


@pytest.fixture(scope="module")
def built(packed: tuple[Path, Release], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_wheel(*packed, tmp_path_factory.mktemp("dist"), "1.0")


def test_pip_installs_it_and_its_scenes_open(
    built: Path, scene_folders: tuple[Path, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = tmp_path / "site"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(site)]
    subprocess.run([*pip, str(built)], check=True, capture_output=True)
    monkeypatch.setenv("PYTHONPATH", str(site))
    asked = subprocess.run([sys.executable, "-m", "spike4dgs_1"], check=True, capture_output=True, text=True)
    folder = Path(asked.stdout.strip())
    assert folder == site / "spike4dgs_1/release"
    assert main(["release", "check", str(folder)]) == 0
    assert main(["download", "all", "--from", str(folder), "--out", str(tmp_path / "data")]) == 0
    for root in scene_folders:
        assert open_scene(tmp_path / "data" / root.name).revision == open_scene(root).revision


def test_the_same_release_gives_the_same_bytes(built: Path, packed: tuple[Path, Release], tmp_path: Path) -> None:
    assert write_wheel(*packed, tmp_path, "1.0").read_bytes() == built.read_bytes()


def test_commands_pack_wheel_and_identify_the_same(
    packed: tuple[Path, Release], built: Path, scene_folders: tuple[Path, ...], tmp_path: Path, capsys
) -> None:
    scenes = list(map(str, scene_folders))
    command = ["release", "pack", *scenes, "--out", str(tmp_path / "1")]
    assert main([*command, "--name", "a b"]) == main([*command, "--shard-mb", "0"]) == 2
    said = capsys.readouterr().err
    assert "--name: expected letters" in said and "--shard-mb: expected at least 1" in said
    assert main([*command, "--shard-mb", "6"]) == 0
    assert files_in(tmp_path / "1") == files_in(packed[0])
    assert main(["release", "wheel", str(packed[0]), "--out", str(tmp_path / "dist")]) == 0
    assert files_in(tmp_path / "dist") == {built.name: built.read_bytes()}
    assert main(["release", "fingerprint", *scenes, "--out", str(tmp_path / "prints")]) == 0
    for scene in map(open_scene, scene_folders):
        found = read_fingerprint(tmp_path / f"prints/{scene.id}@{scene.revision[:12]}.npz")
        assert compare(scene, found).is_equivalent


def test_its_record_lists_every_file(built: Path) -> None:
    with zipfile.ZipFile(built) as archive:
        names = archive.namelist()
        record = archive.read("spike4dgs_1-1.0.dist-info/RECORD").decode().splitlines()
        assert "License: CC0-1.0" in archive.read("spike4dgs_1-1.0.dist-info/METADATA").decode()
    assert [line.partition(",")[0] for line in record] == names


def test_one_that_is_too_large_is_refused_and_nothing_stays(
    packed: tuple[Path, Release], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wheel, "MOST_BYTES", 1_000_000)
    with pytest.raises(UserError, match="a wheel of at most 1.0 MB"):
        write_wheel(*packed, tmp_path / "dist", "1.0")
    assert not list(tmp_path.rglob("*.whl"))


def test_a_version_that_pip_would_not_read_is_refused(packed: tuple[Path, Release], tmp_path: Path) -> None:
    with pytest.raises(UserError, match="^--version: expected numbers with dots"):
        write_wheel(*packed, tmp_path, "first")
