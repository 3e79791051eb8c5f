"""croissant.json against mlcroissant: it validates, its records can be read, its hashes are the manifest's."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_scenes import array_cameras, write_small_scene

from spike4dgs.benchmark.exchange.recording import Recording
from spike4dgs.benchmark.exchange.spikecv import export_spikecv, import_spikecv
from spike4dgs.benchmark.scene.cameras import to_nerfstudio
from spike4dgs.benchmark.scene.manifest import read_manifest
from spike4dgs.benchmark.scene.scene import open_scene


def load(root: Path) -> Any:
    mlcroissant = pytest.importorskip("mlcroissant")
    return mlcroissant.Dataset(jsonld=str(root / "croissant.json"))


def test_every_scene_validates(small_scene: Path) -> None:
    dataset = load(small_scene)
    assert dataset.metadata.name == "pattern-0" and not dataset.metadata.ctx.issues.errors
    missing = {w.partition('"')[2].partition('"')[0].rpartition("/")[2] for w in dataset.metadata.ctx.issues.warnings}
    assert missing == {"citeAs", "datePublished"}, "what only a publisher knows"
    assert dataset.metadata.license == ["https://spdx.org/licenses/CC0-1.0.html"]


def test_records_can_be_read(small_scene: Path) -> None:
    scene, dataset = open_scene(small_scene), load(small_scene)
    targets = [(r["targets/camera"].decode(), r["targets/tick"]) for r in dataset.records("targets")]
    assert targets == [(t.camera, t.tick) for t in scene.targets]
    images = list(dataset.records("images"))
    assert [(small_scene / r["images/file_path"].decode()).is_file() for r in images] == [True] * 3
    assert [(r["images/tick"], r["images/t_us"]) for r in images] == [(20, 1000.0), (40, 2000.0), (60, 3000.0)]


def test_it_lists_the_files_that_there_are(small_scene: Path) -> None:
    manifest = read_manifest(small_scene)
    parts = json.loads((small_scene / "croissant.json").read_text())["distribution"]
    objects = [p for p in parts if p["@type"] == "cr:FileObject"]
    for part in objects:
        size, digest = manifest.files[part["contentUrl"]]
        assert (part["sha256"], part["contentSize"]) == (digest, f"{size} B")
    assert {f"spikes/cam_0{i}.dat" for i in range(4)} <= {p["contentUrl"] for p in objects}
    sets = {p["name"]: sorted(small_scene.glob(p["includes"])) for p in parts if p["@type"] == "cr:FileSet"}
    assert set(sets) == {"images-files", "masks-files", "sparse-files"} and all(sets.values())
    assert "croissant.json" in manifest.files


def test_it_is_a_function_of_the_scene_alone(tmp_path: Path) -> None:
    texts = [(write_small_scene(tmp_path / name) / "croissant.json").read_text() for name in ("one", "two")]
    assert texts[0] == texts[1] and str(tmp_path) not in texts[0]


def test_further_contents_are_listed(small_scene: Path, tmp_path: Path) -> None:
    events = {"t": np.zeros(1, np.int64), "x": np.zeros(1, np.uint16), "y": np.zeros(1, np.uint16)}
    for name in ("calibration/flat/cam_00.dat", "conventional/cam_03/000000.png", "geometry/cam_03/000020.exr"):
        (tmp_path / "again" / name).parent.mkdir(parents=True)
        (tmp_path / "again" / name).write_bytes(b"content")
    (tmp_path / "again/events").mkdir()
    np.savez(tmp_path / "again/events/cam_03.npz", **events)
    root = write_small_scene(tmp_path / "again")
    names = {p["name"] for p in json.loads((root / "croissant.json").read_text())["distribution"]}
    assert {f"{n}-files" for n in ("calibration-flat", "conventional", "geometry", "events")} <= names
    assert not load(root).metadata.ctx.issues.errors
    readme, plain = (root / "README.md").read_text(), (small_scene / "README.md").read_text()
    for text in ("`calibration/flat/CAMERA.dat`", "`conventional/", "`geometry/", "`events/"):
        assert text in readme and text not in plain
    assert "`calibration/dark/" not in readme


def test_a_scene_without_images_validates_too(small_scene: Path, tmp_path: Path) -> None:
    poses = {"frames": [{"camera": c.id, **to_nerfstudio(c)} for c in array_cameras()]}
    (tmp_path / "poses.json").write_text(json.dumps(poses))
    export_spikecv(open_scene(small_scene), tmp_path / "spikecv")
    import_spikecv(tmp_path / "spikecv", tmp_path / "back", Recording(20000.0), tmp_path / "poses.json")
    dataset = load(tmp_path / "back")
    assert not dataset.metadata.ctx.issues.errors and not dataset.metadata.record_sets
    assert dataset.metadata.license == ["unknown"] and not dataset.metadata.creators
