"""The check of scenes without Mitsuba: what equals, what differs by noise, what by the world."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from full_scene import write_full_scene

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import write_json
from spike4dgs.benchmark.scene.images import read_exr, read_geometry, write_exr, write_geometry
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.spikes.stream import pack
from spike4dgs.generators.profiles import PROFILES, Job
from spike4dgs.generators.scene_check import NOISE_FOLDER, check_scenes, find_references
from spike4dgs.generators.scene_differences import differing_facts

JOB = Job("pattern", 0, 0, "tiny", PROFILES["tiny"], PROFILES["tiny"].seconds)


def edit(name: str, change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def apply(root: Path) -> None:
        data = json.loads((root / name).read_text())
        change(data)
        write_json(root / name, data)

    return apply


def add_noise(root: Path, seed: int) -> None:
    """Noise of every pixel of truth, and of one spike in ten."""
    rng = np.random.default_rng(seed)
    for path in root.glob("images/*/*.exr"):
        image = read_exr(path)
        write_exr(path, (image + 0.01 * rng.normal(size=image.shape)).astype(np.float32), 0.0)
    scene = open_scene(root)
    streams = {camera: scene.stream(camera).window(0, scene.n_ticks) for camera in scene.cameras}
    for camera, spikes in streams.items():
        (root / f"spikes/{camera}.dat").write_bytes(pack(spikes ^ (rng.random(spikes.shape) < 0.1)).tobytes())
    write_manifest(root)


@pytest.fixture
def scenes(tmp_path: Path) -> tuple[Path, Path]:
    """A made scene in OUT, and a copy of it among the references."""
    plain = write_full_scene(tmp_path / "plain")
    edit("scene.json", lambda m: m.update(id=JOB.id))(plain)
    write_manifest(plain)
    for number, name in enumerate(("out", "references")):
        root = Path(shutil.copytree(plain, tmp_path / name / JOB.id))
        add_noise(root, number)
    return tmp_path / "out", tmp_path / "references"


def check(out: Path, references: Path) -> tuple[int, dict[str, Any]]:
    """Check with a third noise of the same scene as the floor."""

    def make(job: Job, folder: Path) -> None:
        assert job.noise == 1 and job.render_seed != JOB.render_seed
        assert job.settings == {**JOB.settings, "noise": 1}
        shutil.copytree(out.parent / "plain", folder / job.id)
        add_noise(folder / job.id, 7)

    code = check_scenes([JOB], out, find_references(references, [JOB.id]), make)
    return code, json.loads((out / "check.json").read_text())["scenes"][0]


def change(root: Path, edit: Callable[[Path], None]) -> None:
    edit(root)
    write_manifest(root)


def test_the_same_data_are_equal_without_another_rendering(scenes: tuple[Path, Path]) -> None:
    out, _ = scenes
    shutil.rmtree(scenes[1])
    change(Path(shutil.copytree(out / JOB.id, scenes[1] / JOB.id)), edit("scene.json", lambda m: m.update(title="x")))
    code, found = check(out, scenes[1])
    assert (code, found["verdict"], found["cameras"]) == (0, "equal", {})
    assert not (out / NOISE_FOLDER).exists() and not (out / "check.png").exists()


def test_other_noise_is_rendering_noise(scenes: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    out, references = scenes
    code, found = check(out, references / JOB.id)
    assert (code, found["verdict"], found["reasons"]) == (0, "rendering noise", [])
    camera = found["cameras"]["cam_03"]
    assert camera["found"]["bits"] == pytest.approx(0.18, abs=0.01)  # of two noises of one in ten
    assert camera["found"]["truth_db"] == pytest.approx(camera["noise"]["truth_db"], abs=0.5)
    assert f"{JOB.id}: rendering noise" in capsys.readouterr().out
    assert (out / "check.png").stat().st_size > 10_000 and "rendering noise" in (out / "check.md").read_text()


def brighter(root: Path) -> None:
    """One block of all truths, by as much as the noise of one pixel."""
    for path in root.glob("images/cam_03/*.exr"):
        image = np.array(read_exr(path))
        image[8:16, 16:24] += 0.02
        write_exr(path, image, 0.0)


def moved(transforms: dict[str, Any]) -> None:
    for frame in transforms["frames"]:
        frame["transform_matrix"][0][3] += 1e-6


def deeper(root: Path) -> None:
    path = root / "geometry/cam_03/000020.exr"
    found = read_geometry(path)
    write_geometry(path, found.depth * np.float32(1.01), found.ids, found.flow, 0.0)


def other_map(root: Path) -> None:
    with np.load(root / "truth/cam_01.npz") as data:
        arrays = dict(data)
    np.savez(root / "truth/cam_01.npz", **{**arrays, "gain": arrays["gain"] * np.float32(1.001)})


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (brighter, "all cameras: truths in"),
        (edit("transforms_train.json", moved), "pose of cam_00: by up to 1e-06"),
        (edit("targets.json", lambda t: t["targets"].pop()), "targets of center"),
        (edit("scene.json", lambda m: m.update(radiance_gain=0.61)), "radiance_gain: 0.6, reference 0.61"),
        (deeper, "depth or thing in 1 of 1 images, most in geometry/cam_03/000020.exr: 100.00% of the pixels"),
        (other_map, "gain or dark map of cam_01"),
    ],
)
def test_what_noise_does_not_explain_is_a_change(
    scenes: tuple[Path, Path], damage: Callable[[Path], None], reason: str
) -> None:
    out, references = scenes
    change(references / JOB.id, damage)
    code, found = check(out, references)
    assert (code, found["verdict"]) == (1, "change of the world")
    assert any(reason in line for line in found["reasons"]), found["reasons"]


def test_facts_that_differ_by_rounding_are_the_same(scenes: tuple[Path, Path]) -> None:
    out, references = scenes

    def rounded(transforms: dict[str, Any]) -> None:
        for frame in transforms["frames"]:
            frame["transform_matrix"][0][3] = np.nextafter(frame["transform_matrix"][0][3], 9.0)

    change(references / JOB.id, edit("transforms_train.json", rounded))
    assert differing_facts(open_scene(out / JOB.id), open_scene(references / JOB.id)) == []


def test_a_reference_that_is_missing_is_named(scenes: tuple[Path, Path]) -> None:
    with pytest.raises(UserError, match="the reference scene car-0-tiny, found no such folder"):
        find_references(scenes[1], ["car-0-tiny"])
    with pytest.raises(UserError, match=f"the reference scene car-0-tiny, found scene {JOB.id}"):
        find_references(scenes[1] / JOB.id, ["car-0-tiny"])
