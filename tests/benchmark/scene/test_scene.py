import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from changes import edit_json as change_json
from changes import flip_bit
from small_scenes import GAIN, HEIGHT, TICKS, WIDTH, array_cameras, write_small_scene

from spike4dgs.benchmark import Scene, Target, UserError, open_scene
from spike4dgs.benchmark.scene.images import read_mask
from spike4dgs.benchmark.scene.manifest import write_manifest


def test_a_written_scene_is_read_back(small_scene: Path) -> None:
    scene = open_scene(small_scene)
    assert (scene.id, scene.n_ticks, scene.rate_hz, scene.radiance_gain) == ("pattern-0", TICKS, 20000.0, GAIN)
    assert scene.train == ("cam_00", "cam_01", "cam_02") and scene.test == ("cam_03",)
    assert scene.targets == tuple(Target("cam_03", t) for t in (20, 40, 60))
    assert scene.targets[0].name == "cam_03/000020"
    points = np.random.default_rng(0).normal(size=(20, 3))
    for made in array_cameras():
        read = scene.cameras[made.id]
        assert np.abs(read.project(points)[0] - made.project(points)[0]).max() < 1e-6
        assert (read.width, read.height) == (WIDTH, HEIGHT)
    truth, moving = scene.ground_truth(scene.targets[1]), scene.moving(scene.targets[1])
    assert truth.shape == moving.shape == (HEIGHT, WIDTH) and truth.dtype == np.float32 and moving.dtype == bool


def test_pycolmap_leaves_sigterm_as_it_was(tmp_path: Path) -> None:
    """Its own handler prints thirty lines of C++ calls where a run is ended."""
    code = (
        "import os, signal, sys; from pathlib import Path; from spike4dgs.benchmark.scene.writer import write_colmap\n"
        "write_colmap(Path(sys.argv[1]), (), ()); os.kill(os.getpid(), signal.SIGTERM)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (-signal.SIGTERM, "")


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (
            ["stream.json", "a.dat"],
            "found a folder of streams without poses; `fit`, `inspect` and `images` read it",
        ),
        (
            [f"car-{k}/scene.json" for k in range(6)],
            "a folder of the scenes car-0, car-1, car-2, car-3, ...; name one",
        ),
        (["bird-0/scene.json"], "found a folder of the scenes bird-0; name one"),
        (["a.dat"], "found bare streams; import them with `spike4dgs import-dat`"),
        (["notes.txt"], "scene.json: expected the description of a scene, found no such file; check the path"),
    ],
)
def test_what_is_no_scene_is_told_as_what_it_is(names: list[str], message: str, tmp_path: Path) -> None:
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(UserError, match=message):
        open_scene(tmp_path)
    with pytest.raises(UserError, match="expected a scene folder, found a file; name its folder"):
        open_scene(next(path for path in tmp_path.rglob("*") if path.is_file()))


def test_streams_carry_the_radiance_upright(small_scene: Path) -> None:
    scene = open_scene(small_scene)
    rate = scene.stream("cam_03").counts(0, 40) / 40 / GAIN
    truth = scene.ground_truth(Target("cam_03", 20))
    assert np.abs(rate - truth).mean() < 0.05
    assert np.abs(rate[::-1] - truth).mean() > 0.1


def test_training_holds_the_training_cameras_only(small_scene: Path) -> None:
    training = open_scene(small_scene).training
    assert [c.id for c in training.cameras] == ["cam_00", "cam_01", "cam_02"]
    assert len(training.streams) == 3 and training.radiance_gain == GAIN
    assert training.duration_us == 4000.0
    assert [training.tick(t) for t in (-5.0, 0.0, 49.9, 50.0, 3999.0, 9999.0)] == [0, 0, 0, 1, 79, 79]


@pytest.mark.parametrize("rate_hz", [15_000.0, 25_000.0, 30_000.0, 50_000.0])
def test_the_time_of_a_tick_is_in_that_tick(small_scene: Path, rate_hz: float) -> None:
    training = replace(open_scene(small_scene).training, rate_hz=rate_hz, n_ticks=2000)
    assert [training.tick(t * 1e6 / rate_hz) for t in range(2000)] == list(range(2000))


def test_the_colmap_model_has_the_same_cameras(small_scene: Path) -> None:
    scene = open_scene(small_scene)
    points = np.random.default_rng(0).normal(size=(20, 3))
    for image in pycolmap.Reconstruction(str(small_scene / "sparse/0")).images.values():
        expected = np.array([image.project_point(p) for p in points + [0, 5, 0]])
        assert np.abs(scene.cameras[image.name].project(points + [0, 5, 0])[0] - expected).max() < 0.01


def test_transforms_follow_nerfstudio(small_scene: Path) -> None:
    frames = json.loads((small_scene / "transforms_test.json").read_text())["frames"]
    image = next(f for f in frames if f["file_path"] == "images/cam_03/000040.exr")
    assert (image["tick"], image["t_us"], image["time"]) == (40, 2000.0, 0.5)
    assert {"fl_x", "fl_y", "cx", "cy", "w", "h", "transform_matrix"} <= set(image)


def test_scenes_may_state_what_else_they_hold(tmp_path: Path) -> None:
    extras = {"ground_truth": {"every_ticks": 20}, "conventional": {"rate_hz": 60, "exposure_us": 8333}}
    extras |= {"events": {"contrast": 0.2}, "calibration": {"flat_ticks": 4000}, "instances": {"1": "car"}}
    scene = open_scene(write_small_scene(tmp_path / "scene", extras=extras))
    assert {key: scene.meta[key] for key in extras} == extras
    with pytest.raises(UserError, match=r"Additional properties are not allowed \('weather' was unexpected\)"):
        write_small_scene(tmp_path / "other", extras={"weather": {}})
    with pytest.raises(UserError, match="at instances: 'car' does not match"):
        write_small_scene(tmp_path / "third", extras={"instances": {"car": "1"}})
    with pytest.raises(UserError, match="at events"):
        write_small_scene(tmp_path / "fourth", extras={"events": 3})  # type: ignore[dict-item]


Damage = Callable[[Path], None]


def edit_json(name: str, edit: Callable[[dict[str, Any]], Any], rehash: bool = True) -> Damage:
    """Change a description file, and make the manifest agree, as a program that writes foreign scenes would."""

    def apply(root: Path) -> None:
        change_json(root / name, edit)
        if rehash:
            write_manifest(root)

    return apply


def edit_bytes(name: str, edit: Callable[[bytes], bytes]) -> Damage:
    return lambda root: (root / name).write_bytes(edit((root / name).read_bytes())) and None


def flip(name: str) -> Damage:
    return lambda root: flip_bit(root / name, (root / name).stat().st_size // 2, 3)


def remove(name: str) -> Damage:
    return lambda root: (root / name).unlink()


def set_meta(**values: Any) -> Damage:
    return edit_json("scene.json", lambda meta: meta.update(values))


def add_target(**target: Any) -> Damage:
    return edit_json("targets.json", lambda data: data["targets"].append(target))


def one_split(*train: str) -> Damage:
    return set_meta(splits={"center": {"train": list(train), "test": ["cam_03"]}})


GAP = {"camera": "cam_01", "first_tick": 7, "ticks": 2, "reason": "usb overflow"}


@pytest.mark.parametrize(
    ("damage", "where", "message"),
    [
        (shutil.rmtree, "scene", "expected a scene folder, found no such folder"),
        (remove("scene.json"), "scene.json", "found no such file"),
        (edit_bytes("scene.json", lambda b: b[:50]), "scene.json", "found damaged text"),
        (edit_bytes("scene.json", lambda b: b"\xff\xfe" + b), "scene.json", "found damaged text"),
        (edit_bytes("scene.json", lambda b: b"[1]"), "scene.json", "a JSON object), found list"),
        (edit_bytes("scene.json", lambda b: b'{"frames": []}'), "scene.json", "found schema None"),
        (set_meta(schema="spike4dgs-scene/2"), "scene.json", "found schema 'spike4dgs-scene/2'"),
        (edit_json("scene.json", lambda m: m.pop("rate_hz")), "scene.json", "'rate_hz' is a required property"),
        (set_meta(rate_hz=0), "scene.json", "at rate_hz"),
        (set_meta(n_ticks=2.5), "scene.json", "at n_ticks"),
        (set_meta(units="mm"), "scene.json", "at units"),
        (set_meta(colour=True), "scene.json", "Additional properties are not allowed ('colour' was unexpected)"),
        (set_meta(sensor={"model": "x"}), "scene.json", "at sensor: 'rows_bottom_up' is a required property"),
        (set_meta(id="../other"), "scene.json", "at id"),
        (set_meta(default_split="left"), "scene.json", "expected default_split among the splits, found 'left'"),
        (one_split("cam_00", "cam_03"), "scene.json", "known, distinct cameras, found cam_03 in both parts"),
        (one_split("cam_00", "cam_77"), "scene.json", "found cam_77 without pose or stream"),
        (one_split(), "scene.json", "at splits/center/train"),
        (set_meta(width=HEIGHT, height=WIDTH), "scene.json", "cameras of 24x40 pixels, found cam_00 of 40x24"),
        (
            edit_json("scene.json", lambda m: m["streams"].update(extra="spikes/cam_00.dat")),
            "scene.json",
            "expected a pose of every stream, found extra without",
        ),
        (set_meta(splits={"../evil": {"train": ["cam_00"], "test": []}}), "scene.json", "'../evil' does not match"),
        (set_meta(gaps=[GAP]), "scene.json", "expected a recording without gaps, found 1 gap(s)"),
        (set_meta(gaps=[{"camera": "cam_01"}]), "scene.json", "at gaps/0"),
        (edit_json("scene.json", lambda m: m.update(title="x"), rehash=False), "scene.json", "expected"),
        (remove("manifest.json"), "manifest.json", "found no such file"),
        (edit_json("manifest.json", lambda m: m.update(schema="x"), rehash=False), "manifest.json", "schema"),
        (edit_json("manifest.json", lambda m: m.update(files=3), rehash=False), "manifest.json", "bytes, sha256"),
        (edit_json("manifest.json", lambda m: m["files"].pop("scene.json"), rehash=False), "scene.json", "no entry"),
        (remove("transforms_train.json"), "transforms_train.json", "no such file"),
        (remove("targets.json"), "targets.json", "no such file"),
        (
            edit_json("transforms_test.json", lambda d: d["frames"][0].pop("fl_x")),
            "transforms_test.json",
            "for camera cam_03, found KeyError('fl_x')",
        ),
        (
            edit_json("transforms_train.json", lambda d: d["frames"][1]["transform_matrix"][0].__setitem__(0, 5.0)),
            "transforms_train.json",
            "cam_01: expected a rotation matrix",
        ),
        (edit_json("transforms_train.json", lambda d: d["frames"].pop()), "scene.json", "cam_02 without pose"),
        (edit_json("transforms_train.json", lambda d: d.update(frames=5)), "transforms_train.json", "frames"),
        (edit_json("transforms_train.json", lambda d: d.update(frames=["a"])), "transforms_train.json", "frames"),
        (add_target(camera="cam_03"), "targets.json", "'tick'"),
        (add_target(camera="cam_09", tick=1), "targets.json", "found cam_09 at tick 1"),
        (add_target(camera="cam_03", tick=TICKS), "targets.json", f"found cam_03 at tick {TICKS}"),
        (add_target(camera="cam_00", tick=20), "targets.json", "found cam_00 at tick 20"),
        (add_target(camera="cam_03", tick=20), "targets.json", "cam_03 at tick 20 twice"),
    ],
)
def test_a_scene_that_is_none_is_refused_in_a_line(small_scene: Path, damage: Damage, where: str, message: str) -> None:
    damage(small_scene)
    with pytest.raises(UserError) as e:
        open_scene(small_scene)
    assert where in str(e.value).partition(": expected")[0]
    assert message in str(e.value) and "\n" not in str(e.value)


@pytest.mark.parametrize(
    ("damage", "name", "message"),
    [
        (flip("spikes/cam_01.dat"), "spikes/cam_01.dat", "expected sha256"),
        (edit_bytes("spikes/cam_01.dat", lambda b: b[:-120]), "spikes/cam_01.dat", "bytes (truncated)"),
        (edit_bytes("spikes/cam_01.dat", lambda b: b + b"\0"), "spikes/cam_01.dat", "bytes (longer)"),
        (remove("spikes/cam_01.dat"), "spikes/cam_01.dat", "no such file"),
        (flip("images/cam_03/000020.exr"), "images/cam_03/000020.exr", "expected sha256"),
        (remove("images/cam_03/000020.exr"), "images/cam_03/000020.exr", "no such file"),
        (flip("masks/cam_03/000020.png"), "masks/cam_03/000020.png", "expected sha256"),
        (remove("masks/cam_03/000020.png"), "masks/cam_03/000020.png", "no such file"),
    ],
)
def test_damaged_data_is_refused_by_who_reads_it(small_scene: Path, damage: Damage, name: str, message: str) -> None:
    damage(small_scene)
    with pytest.raises(UserError) as e:
        read_everything(open_scene(small_scene))
    assert name in str(e.value).partition(": expected")[0] and message in str(e.value)
    assert [name in line for line in open_scene(small_scene).manifest.problems()] == [True]


def read_everything(scene: Scene) -> None:
    _ = scene.training
    for t in scene.targets:
        scene.ground_truth(t)
        scene.moving(t)


def test_a_truncated_stream_with_a_manifest_that_agrees_is_refused(small_scene: Path) -> None:
    edit_bytes("spikes/cam_02.dat", lambda b: b[:-120])(small_scene)
    write_manifest(small_scene)
    with pytest.raises(UserError, match=r"spikes/cam_02\.dat: expected 80 ticks, found 79"):
        _ = open_scene(small_scene).training


def test_a_mask_that_is_no_image_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"not an image")
    with pytest.raises(UserError, match=r"a\.png: expected a mask image, found damaged data"):
        read_mask(tmp_path / "a.png")
