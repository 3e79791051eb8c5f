"""What a manifest says of contents is believed on opening, and checked by `verify`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from changes import edit_json

from spike4dgs.benchmark import UserError, open_scene
from spike4dgs.benchmark.files import sha256_file
from spike4dgs.benchmark.scene.manifest import read_manifest
from spike4dgs.benchmark.scene.verify import verify_content
from spike4dgs.cli.verify import verify

TRUTH = "images/cam_03/000020.exr"


def edit_manifest(root: Path, edit: Callable[[dict[str, Any]], Any]) -> None:
    edit_json(root / "manifest.json", lambda manifest: edit(manifest["files"]))


def test_a_forged_content_is_found(full_scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    honest = open_scene(full_scene).revision
    other = full_scene / "images/cam_03/000040.exr"
    (full_scene / TRUTH).write_bytes(other.read_bytes())  # easier truth, under the honest scene's revision
    facts = {"bytes": other.stat().st_size, "sha256": sha256_file(other)}
    edit_manifest(full_scene, lambda files: files[TRUTH].update(facts))
    forged = open_scene(full_scene)
    assert forged.revision == honest and list(forged.manifest.problems()) == []
    (line,) = verify_content(forged)
    assert "000020.exr: expected content" in line
    assert verify((full_scene,)) == 2 and "the manifest claims another content" in capsys.readouterr().err


def test_a_stream_has_no_content_but_its_bytes(full_scene: Path) -> None:
    honest = open_scene(full_scene).revision
    stream = full_scene / "spikes/cam_00.dat"
    stream.write_bytes(stream.read_bytes()[::-1])
    facts = {"sha256": sha256_file(stream), "content": read_manifest(full_scene).files["spikes/cam_00.dat"][1]}
    edit_manifest(full_scene, lambda files: files["spikes/cam_00.dat"].update(facts))
    assert open_scene(full_scene).revision != honest


def test_missing_and_changed_data_are_found_without_the_other_files(full_scene: Path) -> None:
    scene = open_scene(full_scene)
    (full_scene / "README.md").unlink()
    assert list(verify_content(scene)) == []
    (full_scene / "truth/cam_02.npz").unlink()
    (full_scene / TRUTH).write_bytes((full_scene / "images/cam_03/000040.exr").read_bytes())
    lines = list(verify_content(open_scene(full_scene)))
    assert [name for name in ("cam_02", "000020.exr") for line in lines if name in line] == ["cam_02", "000020.exr"]


@pytest.mark.parametrize(
    "name", ["../outside", "/etc/passwd", "a/../../b", "a//b", "./a", "a\\..\\b", "..", "", ".", "C:/x"]
)
def test_a_path_that_leaves_the_folder_is_refused(full_scene: Path, name: str) -> None:
    edit_manifest(full_scene, lambda files: files.update({name: {"bytes": 1, "sha256": "0" * 64}}))
    with pytest.raises(UserError, match=r"manifest.json: expected paths inside the scene folder"):
        open_scene(full_scene)


def test_a_content_that_is_no_hash_is_refused(full_scene: Path) -> None:
    edit_manifest(full_scene, lambda files: files[TRUTH].update(content="abc"))
    with pytest.raises(UserError, match=f"64 hex digits as the content of {TRUTH}"):
        open_scene(full_scene)
