"""make-dataset: whole scenes, resumed after any interruption, refused where something is wrong."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion, map_coordinates

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.images import gray, read_geometry
from spike4dgs.benchmark.scene.scene import Target, open_scene
from spike4dgs.generators import make_dataset as command
from spike4dgs.generators import scene_maker, tasks
from spike4dgs.generators.ground_truth import moving_region
from spike4dgs.generators.profiles import PROFILES, Job
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.render import Still
from spike4dgs.generators.scene_maker import Maker
from spike4dgs.generators.worlds import WORLDS

JOB = Job("car", 0, 0, "tiny", PROFILES["tiny"], PROFILES["tiny"].seconds)


PLAN = KeyPlan(80, 20_000, 0.5, (20, 10))


class FakeRenderer:
    """Images without Mitsuba: a bright square over noise, to the right with time."""

    def __init__(self, world, cameras, *, seed, spp, background_spp, color=False, still=None, whole_frames=False):
        self.cameras, self.color = tuple(cameras), color
        self.shape = (len(cameras), cameras[0].height, cameras[0].width)
        noise = [
            np.random.default_rng([0, *c.id.encode()]).uniform(0.2, 0.4, self.shape[1:]).astype(np.float32)
            for c in cameras
        ]
        self.still = still or Still(*np.repeat(np.stack(noise)[None, ..., None], 2, 0).repeat(3, -1))

    def still_on(self, background):
        return Still(background, background)

    def object_masks(self, t_s):
        x = np.arange(self.shape[2]) - 10 - 5000 * t_s
        return np.broadcast_to((np.abs(x) < 5) & (np.abs(np.arange(self.shape[1]) - 20) < 6)[:, None], self.shape)

    traced = object_masks

    def keys(self, t_s):
        rgb = np.where(self.object_masks(t_s)[..., None], np.float32(0.9), self.still.background)
        return rgb if self.color else gray(rgb)

    reference_frames = None

    def key_arrays(self, tick, plan):
        mask = self.object_masks(tick / 20_000)
        given = {f"given{v}": np.packbits(m) for v, m in enumerate(mask)}
        values = gray(np.full(3, 0.9, np.float32))
        return given | {f"values{v}": np.full(m.sum(), values, np.float32) for v, m in enumerate(mask)}

    def depths(self, t_s):
        return np.full(self.shape, 5.0, np.float32)

    def geometry(self, t_s, dt_s):
        flow = np.zeros((*self.shape, 2), np.float32)
        return self.depths(t_s), self.object_masks(t_s).astype(np.uint32), flow


@cache
def car():
    return WORLDS["car"].build(0, 0, PROFILES["tiny"].seconds)


@pytest.fixture
def fake(monkeypatch):
    monkeypatch.setattr(tasks, "world_of", lambda job: car())
    monkeypatch.setattr(tasks, "plan_of", lambda job: PLAN)
    monkeypatch.setattr(tasks, "MultiViewRenderer", FakeRenderer)
    monkeypatch.setattr(scene_maker, "load_mitsuba", lambda: SimpleNamespace(variant=lambda: "fake"))


def plain(stage, steps, total):
    yield from steps


def files(folder):
    """Relative path -> bytes of every file, hidden ones included."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_scene_is_whole_and_true(fake, tmp_path):
    folder = Maker(JOB, tmp_path, plain).make()
    scene = open_scene(folder)
    assert scene.id == "car-0-tiny"
    assert scene.train == ("cam_00", "cam_02", "cam_07")
    assert scene.test == ("cam_04",)
    assert [t.tick for t in scene.targets] == [20, 40, 60]
    assert not list(scene.manifest.problems())
    assert scene.meta["source"]["seed"] == 0
    assert scene.meta["source"]["versions"]["mitsuba_variant"] == "fake"
    assert set(scene.meta["splits"]) == {"center", "corner", "views-3"}
    assert [t.tick for t in open_scene(folder, split="corner").targets] == [40]
    assert scene.meta["instances"]["1"] == "body" and set(scene.meta["instances"].values()) >= {"rim0", "rim3"}
    renderer = FakeRenderer(None, [scene.cameras["cam_04"]], seed=1, spp=0, background_spp=0)
    for target in scene.targets:
        truth = renderer.keys(target.tick / 20_000)[0]
        assert np.abs(scene.ground_truth(target) - truth).max() < 1e-3  # half floats
        geometry = read_geometry(scene.manifest.path(f"geometry/{target.name}.exr"))
        assert np.array_equal(geometry.ids > 0, renderer.object_masks(target.tick / 20_000)[0])
        mask = scene.moving(target)
        assert mask[renderer.object_masks(target.tick / 20_000)[0]].all()
        assert mask.mean() < 0.2
    counts = scene.stream("cam_00").counts(0, 80)
    still = FakeRenderer(None, [scene.cameras["cam_00"]], seed=0, spp=0, background_spp=0).still.background[0, ..., 0]
    assert np.abs(counts[:10] / 80 / 0.6 - still[:10]).mean() < 0.05
    for name in ("sheet.png", "preview.webp", "croissant.json", "events/cam_00.npz", "calibration/dark/cam_02.dat"):
        assert name in scene.manifest.files
    with np.load(folder / "truth/cam_00.npz") as maps:
        assert set(maps) == {"gain", "dark"}
    assert not (tmp_path / ".work").exists()


class Stop(Exception):
    pass


def test_resumes_after_an_interruption_at_every_step(fake, tmp_path):
    whole = files(Maker(JOB, tmp_path / "whole", plain).make())
    assert "manifest.json" in whole

    def one_step(stage, steps, total):
        for k, step in enumerate(steps):
            if k == 1:
                raise Stop
            yield step
        if total and stage != "background":
            raise Stop

    stops = 0
    while stops < 50:
        try:
            folder = Maker(JOB, tmp_path / "cut", one_step).make()
            break
        except Stop:
            stops += 1
            assert not (tmp_path / "cut" / JOB.id).exists()
            hidden = tmp_path / "cut" / ".work" / JOB.id / "scene" / "images"
            hidden.mkdir(parents=True, exist_ok=True)
            (hidden / ".000020.99.part.exr").write_bytes(b"left by a killed process")
    assert stops >= 8
    assert files(folder) == whole


def test_other_settings_do_not_reuse_unfinished_work(fake, tmp_path):
    def stop_at_truth(stage, steps, total):
        if stage == "ground truth":
            raise Stop
        yield from steps

    other = Job("car", 0, 7, "tiny", PROFILES["tiny"], PROFILES["tiny"].seconds)
    with pytest.raises(Stop):
        Maker(other, tmp_path / "a", stop_at_truth).make()
    mixed = files(Maker(JOB, tmp_path / "a", plain).make())
    clean = files(Maker(JOB, tmp_path / "b", plain).make())
    seven = files(Maker(other, tmp_path / "c", plain).make())
    assert mixed == clean
    assert seven["spikes/cam_00.dat"] != clean["spikes/cam_00.dat"]


def test_maps_that_are_off_leave_no_file_and_change_the_stream(fake, tmp_path):
    job = Job("car", 0, 0, "tiny", PROFILES["tiny"], PROFILES["tiny"].seconds, gain_map=False, dark_map=False)
    off = files(Maker(job, tmp_path / "off", plain).make())
    on = files(Maker(JOB, tmp_path / "on", plain).make())
    assert off["spikes/cam_00.dat"] != on["spikes/cam_00.dat"]
    assert "truth/cam_00.npz" in on
    assert not [name for name in off if name.startswith("truth/")]


def test_two_processes_do_not_make_one_scene(fake, tmp_path):
    with scene_maker._alone(tmp_path / ".work/car-0-tiny.lock"):
        with pytest.raises(UserError, match="run in progress"):
            Maker(JOB, tmp_path, plain).make()


def test_a_complete_scene_is_kept_checked_or_refused(fake, tmp_path, capsys):
    assert command.make_dataset(("car",), profile="tiny", out=tmp_path) == 0
    before = files(tmp_path / "car-0-tiny")
    report = json.loads((tmp_path / "car-0-tiny.report.json").read_text())
    assert set(report["stages_s"]) == {"background", "key frames", "ground truth", "streams", "description"}
    capsys.readouterr()
    assert command.make_dataset(("car",), profile="tiny", out=tmp_path) == 0
    assert "kept" in capsys.readouterr().out
    with pytest.raises(UserError, match="seed 0 instead of 1; pass --replace"):
        command.make_dataset(("car",), profile="tiny", out=tmp_path, seed=1)
    stream = tmp_path / "car-0-tiny/spikes/cam_02.dat"
    data = bytearray(stream.read_bytes())
    data[100] ^= 1
    stream.write_bytes(data)
    with pytest.raises(UserError, match=r"cam_02\.dat.*--replace"):
        command.make_dataset(("car",), profile="tiny", out=tmp_path)
    assert command.make_dataset(("car",), profile="tiny", out=tmp_path, replace=True) == 0
    assert files(tmp_path / "car-0-tiny") == before


def test_a_foreign_folder_is_never_touched(fake, tmp_path):
    folder = tmp_path / "car-0-tiny"
    folder.mkdir()
    (folder / "thesis.txt").write_text("three years of work")
    for replace in (False, True):
        with pytest.raises(UserError, match="move it away"):
            command.make_dataset(("car",), profile="tiny", out=tmp_path, replace=replace)
    (folder / "scene.json").write_text("{}")
    with pytest.raises(UserError, match="something else"):
        command.make_dataset(("car",), profile="tiny", out=tmp_path, replace=True)
    assert (folder / "thesis.txt").exists()


@pytest.mark.parametrize(
    ("worlds", "options", "words"),
    [
        (("moon",), {}, "world: expected one of jaywalk, bicycle, "),
        ((), {}, "at least one world"),
        (("car",), {"profile": "huge"}, "--profile: expected one of tiny, small, paper"),
        (("car",), {"seconds": 0.0}, "--seconds"),
        (("car",), {"seconds": -0.02}, "--seconds"),
        (("car",), {"seconds": 0.0205}, "--seconds"),
        (("car",), {"seconds": float("nan")}, "--seconds"),
        (("car",), {"seed": -1}, "--seed"),
        (("car",), {"variant": -1}, "--seed and --variant"),
    ],
)
def test_bad_arguments_are_one_line(worlds, options, words, tmp_path):
    with pytest.raises(UserError, match=words) as e:
        command.make_dataset(worlds, **{"profile": "tiny", "out": tmp_path} | options)
    assert "\n" not in str(e.value)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_noticed_before_work_begins(fake, tmp_path, monkeypatch):
    monkeypatch.setattr(scene_maker.shutil, "disk_usage", lambda path: SimpleNamespace(free=10_000))
    with pytest.raises(UserError, match="free disk space"):
        command.make_dataset(("car",), profile="tiny", out=tmp_path)


def test_names_tell_a_length_that_is_not_the_profiles():
    assert Job("car", 2, 0, "paper", PROFILES["paper"], 0.5).id == "car-2-paper-500ms"
    assert Job("car", 2, 0, "paper", PROFILES["paper"], 0.1).id == "car-2-paper"
    assert list(Job("car", 0, 0, "small", PROFILES["small"], 0.02).target_ticks) == list(range(20, 400, 20))


def test_moving_region_has_the_object_and_its_moving_shadow_only():
    still = np.full((30, 40), 0.5, np.float32)
    thing = np.zeros((30, 40), bool)
    thing[10:15, 10:15] = True
    image, varies = still.copy(), np.zeros((30, 40), bool)
    image[20:25, 5:20] = 0.3
    varies[:, :12] = True  # the right part of the shadow stands still
    image[2, 2] = 0.9  # a speck of noise
    expected = np.zeros((30, 40), bool)
    expected[8:17, 8:17] = True
    expected[20:25, 5:12] = True
    assert np.array_equal(moving_region(thing, image, still, varies), expected)


def start(out, *more):
    code = "import sys; from spike4dgs.benchmark.cli import main; sys.exit(main(sys.argv[1:]))"
    arguments = ["make-dataset", "car", "--profile", "tiny", "--out", str(out), *more]
    return subprocess.Popen([sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def kill_when(process, pattern: str, folder: Path, count: int):
    """SIGKILL as soon as `count` files match; at once if the process has ended."""
    until = time.monotonic() + 100
    while process.poll() is None and len(list(folder.glob(pattern))) < count and time.monotonic() < until:
        time.sleep(0.002)
    assert process.poll() is None, process.stdout.read().decode()
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL


@pytest.mark.parametrize("worlds", [("car",), ()])
def test_folders_that_cannot_be_written_are_one_error(worlds, fake, tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(UserError, match="file"):
        command.make_dataset(worlds, all=not worlds, profile="tiny", out=tmp_path / "file" / "data")
    assert (tmp_path / "file").read_text() == "no folder"


def test_worlds_are_named_or_all(tmp_path):
    with pytest.raises(UserError, match="names or --all"):
        command.make_dataset(("car",), all=True, out=tmp_path)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A real tiny scene and its report, made by one process without interruption."""
    out = tmp_path_factory.mktemp("whole")
    output, _ = (process := start(out, "--audit")).communicate(timeout=300)
    assert process.returncode == 0, output.decode()
    return out


@pytest.fixture(scope="module")
def whole(made) -> dict[str, bytes]:
    return files(made / "car-0-tiny")


@pytest.mark.slow
def test_the_audit_finds_noise_and_no_more(made):
    report = json.loads((made / "car-0-tiny.report.json").read_text())
    ticks, truth = (report["audit"][k] for k in ("ticks", "ground_truth"))
    assert not all(row["is_key"] for row in ticks["each"]) and len(ticks["each"]) == 4 * 3
    assert ticks["total"]["psnr_db"] > 36 and truth["total"]["psnr_db"] > 40  # 16 and 64 samples a pixel
    assert ticks["total"]["mean_percent"] < 5 and truth["total"]["mean_percent"] < 4
    assert ticks["total"]["mean_percent_moving"] > truth["total"]["mean_percent_moving"] > 0
    assert report["plan"]["keys"] == 5


@pytest.mark.slow
def test_flow_and_depth_of_a_scene_carry_its_images_over(made):
    """Ground truth warped by its flow is the next frame, and depth warps one camera's image into another's."""
    scene = open_scene(made / "car-0-tiny")
    tick, (camera, other) = 40, ("cam_04", "cam_00")
    here, later, there = (
        scene.ground_truth(Target(c, t)) for c, t in ((camera, tick), (camera, tick + 20), (other, tick))
    )
    geometry = read_geometry(scene.manifest.path(f"geometry/{camera}/{tick:06d}.exr"))
    v, u = np.mgrid[: here.shape[0], : here.shape[1]] + 0.5
    moving = binary_erosion(geometry.ids > 0, iterations=2)

    def sampled(image, uv):
        return map_coordinates(image, [uv[..., 1] - 0.5, uv[..., 0] - 0.5], order=1, mode="nearest")

    flowed = sampled(later, np.stack([u, v], -1) + geometry.flow)
    against = sampled(later, np.stack([u, v], -1) - geometry.flow)
    assert np.abs(flowed - here)[moving].mean() < 0.7 * np.abs(against - here)[moving].mean()
    assert (geometry.flow[geometry.ids == 0] == 0).all()
    a, b = scene.cameras[camera], scene.cameras[other]
    uv, _ = b.project(a.unproject(np.stack([u.ravel(), v.ravel()], 1), geometry.depth.ravel().astype(np.float64)))
    warped = sampled(there, uv.reshape(*here.shape, 2))
    seen = ((uv > 1) & (uv < [b.width - 1, b.height - 1])).all(1).reshape(here.shape)
    assert np.median(np.abs(warped - here)[seen]) < 0.6 * np.median(np.abs(there - here)[seen])


@pytest.mark.slow
def test_mitsuba_scene_survives_sigkill_and_more_workers(whole, tmp_path):
    """Killed among the key frames and among the ground truth, then finished by two workers: the same bytes."""
    work = tmp_path / ".work/car-0-tiny"
    kill_when(start(tmp_path), "keys/0*.npz", work, 2)
    assert not (tmp_path / "car-0-tiny").exists()
    kill_when(start(tmp_path, "--workers", "2"), "scene/images/*/*.exr", work, 1)
    output, _ = (process := start(tmp_path, "--workers", "2")).communicate(timeout=300)
    assert process.returncode == 0, output.decode()
    found = files(tmp_path / "car-0-tiny")
    assert found["manifest.json"] == whole["manifest.json"] and found == whole


@pytest.mark.slow
def test_a_cluster_makes_the_same_scene(whole, tmp_path):
    from distributed import LocalCluster

    quiet = {"processes": True, "n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(**quiet, silence_logs=50) as cluster:
        output, _ = (process := start(tmp_path, "--scheduler", cluster.scheduler_address)).communicate(timeout=300)
    assert process.returncode == 0, output.decode()
    assert files(tmp_path / "car-0-tiny") == whole
