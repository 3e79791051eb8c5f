from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from fake_renderer import files

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import sha256_file
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.leaderboard.season.secret_folder import pack_scene


def test_a_pack_unpacks_to_the_scene(small_scene: Path, tmp_path: Path) -> None:
    scene = open_scene(small_scene)
    digest = pack_scene(scene, tmp_path / "s.tar")
    assert digest == sha256_file(tmp_path / "s.tar")
    subprocess.run(["tar", "xf", "s.tar"], cwd=tmp_path, check=True)
    assert files(tmp_path / scene.id) == files(small_scene)


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
