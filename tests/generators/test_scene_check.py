"""The check of scenes against a reference: differences, verdict, report."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changes import edit_json
from scipy.ndimage import binary_dilation
from small_scenes import HEIGHT, TICKS, WIDTH, write_small_scene

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.images import read_exr, read_geometry, read_mask, write_exr, write_geometry, write_mask
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.generators import scene_check, scene_differences
from spike4dgs.generators.profiles import PROFILES, Job
from spike4dgs.generators.scene_check import CHANGE, EQUAL, NOISE, Comparison, find_references, to_markdown
from spike4dgs.generators.scene_differences import Difference, difference


def opened(root: Path) -> Scene:
    write_manifest(root)
    return open_scene(root)


def test_a_scene_does_not_differ_from_itself(one_full_scene: Path) -> None:
    scene = open_scene(one_full_scene)
    found = difference(scene, scene, "cam_03")
    assert (found.bits, found.spikes_block_rms, found.truth_rms, found.truth_block_max) == (0, 0, 0, 0)
    assert found.truth_db is None and difference(scene, scene, "cam_01").truth_rms is None
    assert [t.tick for t in scene_differences.images_of(scene, "cam_03")] == [20, 40, 60]


def test_bits_are_those_of_plain_arrays() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 700, 5, 7)) < 0.3
    streams = [SpikeStream(pack(x), 7, 5, 20000.0) for x in (a, b)]
    assert math.isclose(scene_differences.bits_that_differ(*streams), np.mean(a != b))


def brighten(root: Path, by: float) -> None:
    """One block of all truths."""
    for path in root.glob("images/cam_03/*.exr"):
        image = np.array(read_exr(path))
        image[8:16, 16:24] += by
        write_exr(path, image, 0.0)


def test_a_known_change_of_truth_is_measured(one_small_scene: Path, small_scene: Path) -> None:
    brighten(small_scene, 0.125)
    found = difference(open_scene(one_small_scene), opened(small_scene), "cam_03")
    share = 64 / (HEIGHT * WIDTH)
    assert found.truth_rms == pytest.approx(0.125 * math.sqrt(share), rel=0.01)
    assert found.truth_block_max == pytest.approx(0.125, rel=0.01)
    assert found.truth_block_rms == pytest.approx(0.125 * math.sqrt(share), rel=0.01)
    assert found.truth_db == pytest.approx(-20 * math.log10(0.125 * math.sqrt(share)), abs=0.1)
    assert found.bits == 0


def test_a_silent_block_of_spikes_is_measured(one_small_scene: Path, small_scene: Path) -> None:
    spikes = (a := open_scene(one_small_scene)).stream("cam_00").window(0, TICKS)
    silent = spikes.copy()
    silent[:, 8:16, 16:24] = 0
    (small_scene / "spikes/cam_00.dat").write_bytes(pack(silent).tobytes())
    found = difference(a, opened(small_scene), "cam_00")
    lost = spikes[:, 8:16, 16:24].mean()
    assert found.bits == pytest.approx(spikes[:, 8:16, 16:24].sum() / spikes.size)
    assert found.spikes_block_max == pytest.approx(lost)
    assert found.spikes_block_rms == pytest.approx(lost / math.sqrt(15))


def test_an_image_smaller_than_a_block_has_none(tmp_path: Path) -> None:
    scene = open_scene(write_small_scene(tmp_path / "scene", width=7))
    assert difference(scene, scene, "cam_03").truth_block_max == 0


def test_block_means_leave_out_what_is_over() -> None:
    image = np.arange(20.0 * 17).reshape(20, 17)
    found = scene_differences.block_means(image)
    assert found.shape == (2, 2) and found[1, 1] == image[8:16, 8:16].mean()


FLOOR = Difference(0.17, 1e-3, 4e-3, 5e-3, 1e-3, 4e-3, 2e-3)


def compared(found: Difference, noise: Difference = FLOOR, facts: tuple[str, ...] = (), other: str = "b") -> Comparison:
    return Comparison("car-0-tiny", "a" * 64, other * 64, facts, {"cam_00": found}, {"cam_00": noise})


def test_the_verdict_is_by_revision_then_facts_then_noise() -> None:
    assert compared(FLOOR, other="a").verdict == EQUAL
    assert compared(FLOOR).verdict == NOISE and compared(FLOOR).reasons == []
    assert compared(FLOOR, facts=("n_ticks: 80, reference 400",)).verdict == CHANGE
    assert compared(Difference(0, 0, 0, 0, 0, 0)).verdict == NOISE


LIMITS = scene_check.MOST_OF_CAMERA | scene_check.MOST_OF_ALL


@pytest.mark.parametrize("name", LIMITS)
def test_each_measure_alone_tells_a_change(name: str) -> None:
    values = {field: getattr(FLOOR, field) for field in LIMITS}
    for factor, verdict in ((0.99, NOISE), (1.01, CHANGE)):
        found = compared(Difference(**{**values, name: values[name] * LIMITS[name] * factor}))
        assert found.verdict == verdict and len(found.reasons) == (verdict == CHANGE)


def test_blocks_count_over_all_cameras_and_bits_by_camera() -> None:
    def of_three(name: str, factor: float) -> list[str]:
        noise = {f"cam_{i}": FLOOR for i in range(3)}
        louder = replace(FLOOR, **{name: factor * getattr(FLOOR, name)})
        return scene_check.beyond_noise(noise | {"cam_1": louder}, noise)

    (line,) = of_three("bits", 1.3)
    assert line == "cam_1: spike bits differ 1.3 times as much as by noise; up to 1.25 times is noise"
    assert of_three("truth_block_rms", 2.6) == []  # sqrt((1 + 1 + 2.6^2) / 3) = 1.71
    (line,) = of_three("truth_block_rms", 2.8)
    assert line.startswith("all cameras: truths in blocks differ 1.81 times")
    (line,) = of_three("spikes_block_max", 2.6)
    assert line.startswith("all cameras: spikes per tick in the worst block differ 2.6 times")


def test_without_noise_any_difference_is_a_change() -> None:
    still = Difference(0, 0, 0, 0, 0, 0)
    found = compared(Difference(1e-4, 0, 0, 0, 0, 0), still)
    assert found.verdict == CHANGE and "spike bits differ and not by noise" in found.reasons[0]
    assert compared(Difference(0, 0, 0), Difference(0, 0, 0)).verdict == NOISE


def test_the_report_has_the_figures_beside_those_of_noise() -> None:
    text = to_markdown([compared(Difference(0.5, 1e-3, 4e-3, 0.1, 1e-3, 4e-3))])
    assert "| car-0-tiny | change of the world | aaaaaaaaaaaaaaaa | bbbbbbbbbbbbbbbb |" in text
    assert "| cam_00 | 50.000% | 17.000% | 20.0 | 46.0 | 1.00e-03 | 1.00e-03 | 1.00e-03 | 1.00e-03 |" in text
    assert "- cam_00: spike bits differ 2.94 times as much as by noise; up to 1.25 times is noise" in text
    assert to_markdown([compared(FLOOR, other="a")]).count("## car-0-tiny: equal") == 1


JOB = Job("pattern", 0, 0, "tiny", PROFILES["tiny"], PROFILES["tiny"].seconds)


def edit(name: str, change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    return lambda root: edit_json(root / name, change)


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


@pytest.fixture(scope="module")
def three_noises(tmp_path_factory: pytest.TempPathFactory, one_full_scene: Path) -> Path:
    """A folder with a scene of one name in OUT, among the references, and as it is rendered once more."""
    folder = tmp_path_factory.mktemp("noises")
    for number, name in enumerate(("out", "references", "third")):
        root = Path(shutil.copytree(one_full_scene, folder / name / JOB.id))
        edit("scene.json", lambda m: m.update(id=JOB.id))(root)
        write_manifest(root)
        add_noise(root, number)
    return folder


@pytest.fixture
def scenes(three_noises: Path, tmp_path: Path) -> tuple[Path, Path]:
    """A made scene in OUT, and the same world with other noise among the references, which a test may damage."""
    shutil.copytree(three_noises, tmp_path, dirs_exist_ok=True)
    return tmp_path / "out", tmp_path / "references"


def check(out: Path, references: Path) -> tuple[int, dict[str, Any]]:
    """Check with a third noise of the same scene as the floor."""

    def make(job: Job, folder: Path) -> None:
        assert job.noise == 1 and job.render_seed != JOB.render_seed
        assert job.settings == {**JOB.settings, "noise": 1}
        if not (folder / job.id).exists():
            shutil.copytree(out.parent / "third" / job.id, folder / job.id)

    code = scene_check.check_scenes([JOB], out, find_references(references, [JOB.id]), make)
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
    assert not (out / scene_check.NOISE_FOLDER).exists() and not (out / "check.png").exists()


def test_other_noise_is_rendering_noise(scenes: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    out, references = scenes
    code, found = check(out, references / JOB.id)
    assert (code, found["verdict"], found["reasons"]) == (0, "rendering noise", [])
    camera = found["cameras"]["cam_03"]
    assert camera["found"]["bits"] == pytest.approx(0.18, abs=0.01)  # of two noises of one in ten
    assert camera["found"]["truth_db"] == pytest.approx(camera["noise"]["truth_db"], abs=0.5)
    assert f"{JOB.id}: rendering noise" in capsys.readouterr().out
    assert (out / "check.png").stat().st_size > 10_000 and "rendering noise" in (out / "check.md").read_text()


def test_a_world_that_changed_since_the_last_check_is_not_judged_by_the_noise_of_before(
    scenes: tuple[Path, Path],
) -> None:
    out, references = scenes
    assert check(out, references)[1]["verdict"] == "rendering noise"
    for root in (out / JOB.id, out.parent / "third" / JOB.id):  # the world, from now on
        change(root, lambda root: brighten(root, 0.1))
    assert check(out, references)[1]["verdict"] == "change of the world"
    assert len(list((out / scene_check.NOISE_FOLDER / JOB.id).iterdir())) == 1


def moved(transforms: dict[str, Any], change: Callable[[float], float] = lambda x: x + 1e-6) -> None:
    for frame in transforms["frames"]:
        frame["transform_matrix"][0][3] = change(frame["transform_matrix"][0][3])


def deeper(root: Path) -> None:
    path = root / "geometry/cam_03/000020.exr"
    found = read_geometry(path)
    write_geometry(path, found.depth * np.float32(1.01), found.ids, found.flow, 0.0)


def other_map(root: Path) -> None:
    with np.load(root / "truth/cam_01.npz") as data:
        arrays = dict(data)
    np.savez(root / "truth/cam_01.npz", **{**arrays, "gain": arrays["gain"] * np.float32(1.001)})


def larger_masks(root: Path) -> None:
    for path in root.glob("masks/cam_03/*.png"):
        write_mask(path, binary_dilation(read_mask(path)))


FACTS = {
    "pose of cam_00: by up to 1e-06": edit("transforms_train.json", moved),
    "targets of center": edit("targets.json", lambda t: t["targets"].pop()),
    "radiance_gain: 0.6, reference 0.61": edit("scene.json", lambda m: m.update(radiance_gain=0.61)),
}
DATA = {
    "all cameras: truths in": lambda root: brighten(root, 0.02),  # as the noise of one pixel
    "depth or thing in 1 of 1 images, most in geometry/cam_03/000020.exr: 100.00% of the pixels": deeper,
    "gain or dark map of cam_01": other_map,
    "all cameras: masks differ and not by noise": larger_masks,
}


@pytest.mark.parametrize("damages", [FACTS, DATA], ids=["facts", "data"])
def test_what_noise_does_not_explain_is_a_change(
    scenes: tuple[Path, Path], damages: dict[str, Callable[[Path], None]]
) -> None:
    """Each is named beside the others; data are looked at where no fact differs."""
    out, references = scenes
    for damage in damages.values():
        change(references / JOB.id, damage)
    code, found = check(out, references)
    assert (code, found["verdict"]) == (1, "change of the world")
    for reason in damages:
        assert any(reason in line for line in found["reasons"]), found["reasons"]


def test_a_reference_of_another_size_is_a_change(scenes: tuple[Path, Path]) -> None:
    out, references = scenes
    shutil.rmtree(references / JOB.id)
    wide = write_small_scene(references / JOB.id, width=2 * WIDTH)
    change(wide, edit("scene.json", lambda m: m.update(id=JOB.id)))
    code, found = check(out, references)
    assert (code, found["verdict"], found["cameras"]) == (1, "change of the world", {})
    assert any("width" in line for line in found["reasons"]), found["reasons"]
    assert not (out / "check.png").exists()


def test_facts_that_differ_by_rounding_are_the_same(scenes: tuple[Path, Path]) -> None:
    out, references = scenes
    change(references / JOB.id, edit("transforms_train.json", lambda t: moved(t, lambda x: np.nextafter(x, 9.0))))
    assert scene_differences.differing_facts(open_scene(out / JOB.id), open_scene(references / JOB.id)) == []


def test_a_reference_that_is_missing_is_named(scenes: tuple[Path, Path]) -> None:
    with pytest.raises(UserError, match="the reference scene car-0-tiny, found no such folder"):
        find_references(scenes[1], ["car-0-tiny"])
    with pytest.raises(UserError, match=f"the reference scene car-0-tiny, found scene {JOB.id}"):
        find_references(scenes[1] / JOB.id, ["car-0-tiny"])
