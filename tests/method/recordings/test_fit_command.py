"""`fit`, end to end: recordings with and without poses, without a file of truth, and killed."""

import fcntl
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from changes import leave_part
from devtools import Page
from PIL import Image
from small_scenes import write_small_scene
from toy_world import GAIN, RATE_HZ, ToyWorld

from spike4dgs.benchmark import plugins
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import write_json
from spike4dgs.benchmark.method import FitRequest
from spike4dgs.benchmark.metrics.pose_error import align_cameras, pose_errors
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.runs.apart.training_part import write_training_part
from spike4dgs.benchmark.runs.record import read_record
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import TrainingScene, open_scene
from spike4dgs.benchmark.scene.writer import SceneDescription, finish_scene, stream_name
from spike4dgs.benchmark.spikes.folder import open_stream_folder, write_stream_folder
from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.stream import SpikeStream, SpikeWriter, pack
from spike4dgs.cli import main
from spike4dgs.method import load_model
from spike4dgs.method.recordings import fit as fit_module
from spike4dgs.method.recordings import report_page
from spike4dgs.method.recordings.fit import MODEL, PREDICTIONS, REPORT, SHEET, VIDEO
from spike4dgs.method.recordings.held_out import SHOWN, HeldOutView, held_out_views
from spike4dgs.method.recordings.recording import open_recording, own_frame, streams_revision

WORLD = ToyWorld(width=96, height=60, n_ticks=60, travel=0.0, seed=1, views=(0, 2, 5, 7))
SHORT = ("--budget", "0.02", "--device", "cpu")
QUICK = (*SHORT, "--poses", "given")


def write_streams(folder: Path, name: str = "{}.dat") -> dict[str, SpikeStream]:
    """Write the streams of the toy world's training cameras."""
    for camera, stream in zip(WORLD.training.cameras, WORLD.training.streams, strict=True):
        with SpikeWriter(folder / name.format(camera.id), WORLD.width, WORLD.height) as writer:
            writer.write(pack(stream.window(0, WORLD.n_ticks)))
    return dict(zip((c.id for c in WORLD.training.cameras), WORLD.training.streams, strict=True))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene folder of the toy world as a recorder of real cameras leaves it: poses and streams, no truth at all."""
    root = tmp_path_factory.mktemp("recorded") / "toy"
    write_streams(root, stream_name("{}"))
    cameras = WORLD.training.cameras
    about = {"id": "toy", "title": "A toy world", "licence": "CC0-1.0", "source": {"kind": "recorder"}}
    clock = {"rate_hz": RATE_HZ, "n_ticks": WORLD.n_ticks, "radiance_gain": GAIN}
    array = {"cameras": cameras, "train": tuple(c.id for c in cameras), "test": (), "targets": ()}
    sensor = {"model": "toy", "rows_bottom_up": True}
    finish_scene(root, SceneDescription(**about, **clock, **array, sensor=sensor))
    return root


@pytest.fixture(scope="module")
def fitted(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("fitted") / "out"
    assert main(["fit", str(recorded), "--method", "tfp+4dgs", "--out", str(out), *SHORT]) == 0
    return out


@pytest.fixture(scope="module", autouse=True)
def _short_videos() -> Iterator[None]:
    """Ten frames, not 300: rendering and packing them takes longer than a fit."""
    assert fit_module.FPS == 30
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_module, "FPS", 1.0)
        patch.setattr(fit_module, "SLOW_FPS", 1.0)  # of a machine that is busy
        yield


@pytest.fixture
def no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """A gray pixel for the sheet and the report's plot, which take as long as all the rest."""
    pixel = Image.new("L", (1, 1))
    pixel.save(png := BytesIO(), "png")
    monkeypatch.setattr(fit_module, "write_sheet", lambda path, *_: pixel.save(path))
    monkeypatch.setattr(report_page, "poses_plot", lambda *_: png.getvalue())


def tensors(out: Path) -> dict[str, torch.Tensor]:
    from safetensors.torch import load_file

    return load_file(out / MODEL)


def table_rows(page: str, name: str) -> list[list[str]]:
    """Return the cells of the table rows whose first cell begins with a name."""
    rows = [re.findall(r"<td[^>]*>([^<]*)</td>", row) for row in re.findall(r"<tr>(.*?)</tr>", page)]
    return [cells for cells in rows if cells and cells[0].startswith(name)]


def same_model(a: Path, b: Path) -> bool:
    first, second = tensors(a), tensors(b)
    return first.keys() == second.keys() and all(torch.equal(first[k], second[k]) for k in first)


def test_a_fit_leaves_a_model_a_sheet_a_video_and_a_report(fitted: Path) -> None:
    assert {p.name for p in fitted.iterdir()} == {MODEL, SHEET, VIDEO, REPORT, ".lock"}
    with Image.open(fitted / SHEET) as sheet:
        assert sheet.width > 1000 and len(set(sheet.convert("L").getdata())) > 100
    video = cv2.VideoCapture(str(fitted / VIDEO))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == 10
    ok, frame = video.read()
    assert ok and frame.shape == (120, 192, 3) and frame.std() > 10


def test_a_model_of_one_size_gets_a_video_of_that_size(tmp_path: Path) -> None:
    """The nearest view's image is that of its camera, at any size that is asked for; a video's sides are even."""
    about = SimpleNamespace(cameras=WORLD.training.cameras, duration_us=3000.0)
    for asked, made in ((None, (120, 192)), ((61, 97), (60, 96))):
        model = SimpleNamespace(render=lambda c, t, size=asked: np.zeros(size or (c.height, c.width), np.float32))
        fit_module._write_video(tmp_path / VIDEO, SimpleNamespace(model=model, provenance=about))
        ok, frame = cv2.VideoCapture(str(tmp_path / VIDEO)).read()
        assert ok and frame.shape[:2] == made


def test_the_report_is_one_page_that_needs_no_network(fitted: Path) -> None:
    page = (fitted / REPORT).read_text()
    own = r"data:(?:image/png;base64)?,|(?:video\.mp4|sheet\.png)\""
    assert not re.search(rf"(src|href)=\"(?!{own})", page) and "url(" not in page
    assert page.count("<img") == 2 and "<script" not in page
    text = re.sub(r"<[^>]+>", " ", re.sub(r"base64,[^\"]+", "", page))
    said = ("given by the scene", "not a score", "60 ticks at 20000 Hz: 3 ms", "tfp+4dgs on toy", "torch", "cpu:")
    for words in said:
        assert words in text
    rows = table_rows(page, "cam_")
    assert [row[0] for row in rows] == [c.id for c in WORLD.training.cameras]
    for (_, *cells), stream in zip(rows, WORLD.training.streams, strict=True):
        assert float(cells[2]) == pytest.approx(stream.window(0, 60).mean(), abs=1e-4)  # the mean rate
        assert cells[5:9] == ["0", "0", "0", "1.000"]  # bad pixels, by isolation, and the gain


@pytest.mark.parametrize("width", [320, 1400])
def test_the_report_fits_a_phone(fitted: Path, empty_page: Page, width: int) -> None:
    page = empty_page
    page.show((fitted / REPORT).as_uri(), "document.readyState == 'complete'", width=width, height=2000)
    assert page.value("document.documentElement.scrollWidth") <= width
    widest = "Math.max(...[...document.querySelectorAll('img, video')].map(e => e.getBoundingClientRect().right))"
    assert page.value(widest) <= width
    table = "document.querySelector('.scroll:has(thead)')"
    assert page.value(f"{table}.scrollWidth") > 320, "a table keeps its width and scrolls"
    assert page.value(f"{table}.querySelector('tbody tr:last-child').offsetHeight") < 60, "on one line a row"


def test_residuals_are_those_of_the_saved_model(fitted: Path, recorded: Path) -> None:
    from spike4dgs.baselines.images.table import IMAGES

    saved, scene = load_model(fitted / MODEL), open_scene(recorded).training
    ticks = np.rint(np.linspace(10, 49, 5)).astype(int)  # an edge away from the ends, every half a millisecond
    (cells,) = table_rows((fitted / REPORT).read_text(), "cam_00")
    images = IMAGES["tfp"](scene.streams[0], [int(t) for t in ticks], GAIN)
    rendered = np.stack([saved.model.render(scene.cameras[0], t * 50.0) for t in ticks])
    error = np.mean((np.clip(images, 0, 1).astype(float) - np.clip(rendered, 0, 1)) ** 2)
    assert float(cells[-1]) == pytest.approx(-10 * np.log10(error), abs=0.006)


def test_other_commands_take_the_model(fitted: Path, recorded: Path, tmp_path: Path) -> None:
    from spike4dgs.method.viewing.content import open_content

    content = open_content(load_model(fitted / MODEL), recorded)
    assert content.modes == ("rendered", "spike rate", "error")
    out = tmp_path / "frames"
    assert main(["render", str(fitted / MODEL), "--frames", str(out), "--slow-motion", "50", "--scale", "1"]) == 0
    assert len(list(out.iterdir())) == 5


def test_no_file_of_truth_is_read(tmp_path: Path, no_plots: None, capsys: pytest.CaptureFixture[str]) -> None:
    whole = write_small_scene(tmp_path / "whole")
    bare = Path(shutil.copytree(whole, tmp_path / "bare"))
    for name in ("images", "masks", "geometry", "truth"):
        shutil.rmtree(bare / name, ignore_errors=True)
    (bare / open_scene(whole).meta["streams"]["cam_03"]).unlink()  # the held-out camera's stream
    write_json(bare / "targets.json", {"targets": []})
    write_manifest(bare)
    for scene in (whole, bare):
        arguments = ["fit", str(scene), "--method", "tfp+static", "--out", str(tmp_path / f"{scene.name}-fit"), *QUICK]
        assert main(arguments) == 0
    assert same_model(tmp_path / "whole-fit", tmp_path / "bare-fit")
    said = capsys.readouterr().out
    assert "the fit does not see the held-out cam_03" in said
    assert "held-out cam_03 by their own spikes: no score (not computed: the stream or the recordings of cam_03" in said


def test_a_held_out_camera_whose_stream_is_kept_back_is_taken_as_given(small_scene: Path, tmp_path: Path) -> None:
    part = write_training_part(open_scene(small_scene), tmp_path / "part")
    (view,) = held_out_views(part, part.training, ("poses", "clocks"), 0).values()
    assert view == HeldOutView(part.cameras["cam_03"])


class Gray:
    """A method whose models cannot be saved: they show 0.4 at any size."""

    name, params = "gray", dict[str, Any]()

    def fit(self, scene: TrainingScene, request: FitRequest) -> "Gray":
        return self

    def render(self, camera: Camera, t_us: float) -> Float32:
        return np.full((camera.height, camera.width), 0.4, np.float32)


def test_a_model_that_cannot_be_saved_has_reports_and_no_file_of_an_earlier_one_beside(
    fitted: Path, recorded: Path, tmp_path: Path, no_plots: None, monkeypatch
) -> None:
    entry = SimpleNamespace(name="theirs", value="theirs:METHODS", dist=None, load=lambda: {"gray": Gray()})
    monkeypatch.setattr(plugins, "entry_points", lambda group: [entry])
    out = Path(shutil.copytree(fitted, tmp_path / "out"))
    (out / MODEL).unlink()
    (out / PREDICTIONS).mkdir(exist_ok=True)
    (out / PREDICTIONS / "prediction.json").write_text("{}")
    arguments = ["fit", str(recorded), "--method", "gray", "--out", str(out), "--poses", "given"]
    assert main(arguments) == 0
    assert {path.name for path in out.iterdir()} == {".lock", VIDEO, SHEET, REPORT}, "no model: it cannot be saved"
    assert "cannot be saved" in (out / REPORT).read_text()


def test_held_out_cameras_are_judged_by_their_own_spikes(tmp_path: Path, no_plots: None, capsys) -> None:
    bare = write_small_scene(tmp_path / "scene")
    for name in ("images", "masks"):
        shutil.rmtree(bare / name)
    write_json(bare / "targets.json", {"targets": []})
    write_manifest(bare)
    out = tmp_path / "out"
    assert main(["fit", str(bare), "--method", "tfp+static", "--out", str(out), *QUICK]) == 0
    said = capsys.readouterr().out
    assert main(["score", str(out / PREDICTIONS), str(bare), "--out", str(tmp_path / "record.json")]) == 0
    values = read_record(tmp_path / "record.json")["scenes"]["pattern-0"]["metrics"]
    assert values["psnr"] is None and values["spike_psnr_5_dynamic"] is None
    assert f"cam_03 by their own spikes: spike_psnr_5 {values['spike_psnr_5']:.3f}" in said
    page = (out / REPORT).read_text()
    ((_, images, *shown),) = table_rows(page, "cam_03")
    assert images == "3" and shown == [METRICS[m].format(values[m]) for m in SHOWN]
    assert table_rows(page, "mean") == [["mean", "3", *shown]], "the mean over cameras too"


def test_the_revision_of_streams_is_that_of_their_description_too(tmp_path: Path) -> None:
    """Else a fit after a correction of stream.json would find the model of the wrong one, and keep it."""
    write_stream_folder(tmp_path, write_streams(tmp_path))
    given = open_stream_folder(tmp_path)
    gap, order = Gap("cam_00", 5, 2, "lost"), dict(reversed(given.items()))
    corrections = {"width": 60, "height": 96, "rate_hz": 40000.0, "rows_bottom_up": False, "dead_ticks": 1.0}
    streams = [replace(given["cam_00"], **{name: value}) for name, value in (*corrections.items(), ("gaps", (gap,)))]
    corrected = {streams_revision({**given, "cam_00": stream}) for stream in streams}
    assert len(corrected) == 6 and streams_revision(given) not in corrected
    assert streams_revision(order) == streams_revision(open_stream_folder(tmp_path)) == streams_revision(given)


def test_streams_without_poses_get_estimated_ones(tmp_path: Path, no_plots: None, capsys) -> None:
    folder = tmp_path / "_my streams, ä"  # a model's file names it
    write_stream_folder(folder, write_streams(folder))
    out = tmp_path / "out"
    assert main(["fit", str(folder), "--method", "tfp+static", "--out", str(out), *QUICK]) == 0
    said = capsys.readouterr().out
    assert "poses: estimated with COLMAP" in said and "white is taken to be" in said
    assert "estimated with COLMAP" in (out / REPORT).read_text()
    assert load_model(out / MODEL).provenance.scene == "my-streams"
    found = load_model(out / MODEL).provenance.cameras
    errors = pose_errors(found, WORLD.training.cameras).summary()
    assert errors["rotation_max_deg"] < 1.5 and errors["translation_max_m"] < 0.05


def test_an_array_in_its_own_frame_is_the_same_array() -> None:
    cameras = WORLD.cameras
    own = own_frame(cameras)
    centers = np.stack([c.center for c in own])
    np.testing.assert_allclose(centers.mean(axis=0), 0, atol=1e-12)
    assert np.linalg.norm(centers[:, None] - centers[None], axis=-1).max() == pytest.approx(1)
    mean = np.mean([c.R for c in own], axis=0)
    np.testing.assert_allclose(
        mean / np.linalg.norm(mean, axis=1)[:, None], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=0.02
    )
    points = np.random.default_rng(0).normal(size=(20, 3))
    move = align_cameras(cameras, own)
    for before, after in zip(cameras, own, strict=True):
        np.testing.assert_allclose(after.project(move(points))[0], before.project(points)[0], atol=1e-6)


def test_streams_that_do_not_belong_together_or_are_dark_are_refused(tmp_path: Path) -> None:
    def write(side: int, **ticks: int) -> None:
        streams = {}
        for name, count in ticks.items():
            with SpikeWriter(tmp_path / f"{name}.dat", side, side) as writer:
                writer.write(np.zeros((count, side * side // 8), np.uint8))
            streams[name] = SpikeStream(np.zeros((count, side * side // 8), np.uint8), side, side, RATE_HZ)
        write_stream_folder(tmp_path, streams)

    write(8, a=8, b=9)
    with pytest.raises(UserError, match="three or more streams of one size, rate and length"):
        open_recording(tmp_path)
    for few in ({"a": 8}, {"a": 8, "b": 8}):  # COLMAP registers no two views
        write(8, **few)
        with pytest.raises(UserError, match=rf"found {len(few)} stream\(s\)"):
            open_recording(tmp_path)
    write(64, a=8, b=8, c=8)
    with pytest.raises(UserError, match="expected two cameras that recorded spikes, in most ticks, found 0"):
        open_recording(tmp_path)


def test_a_second_run_makes_only_the_reports_again(fitted: Path, recorded: Path, tmp_path, no_plots: None) -> None:
    out = Path(shutil.copytree(fitted, tmp_path / "out"))
    (out / REPORT).unlink()
    before, half = (out / MODEL).stat().st_mtime_ns, leave_part(out)
    assert main(["fit", str(recorded), "--method", "tfp+4dgs", "--out", str(out), *QUICK]) == 0
    assert (out / MODEL).stat().st_mtime_ns == before and (out / REPORT).is_file()
    assert not half.exists()


def test_what_cannot_be_done_is_said(fitted: Path, recorded: Path, tmp_path: Path, capsys) -> None:
    for arguments, message in (
        (("--out", str(fitted), "--seed", "1"), "another --out, or remove it"),
        (("--out", str(recorded)), "expected a folder for the results of a fit, found a recording (scene.json)"),
        (
            ("--out", str(tmp_path / "b"), "--method", "magic"),
            "--method: expected a name that `spike4dgs methods` lists, found 'magic'",
        ),
        (("--out", str(tmp_path / "c"), "--budget", "much"), "--budget"),
        (("--out", str(tmp_path / "e"), "--set", "images.time_spacing_ticks=0"), "_ticks and max_times of 1"),
        (("--out", str(tmp_path / "e"), "--set", "density.refine_every=0"), "refine_every of 1 step or more"),
        (("--out", str(tmp_path / "f"), "--set", "trainer.lr_last=0"), "learning rates above 0"),
    ):
        method = () if "--method" in arguments else ("--method", "tfp+4dgs")
        budget = () if "--budget" in arguments else ("--budget", "0.02")
        assert main(["fit", str(recorded), *arguments, *method, *budget, "--poses", "given"]) == 2
        assert message in capsys.readouterr().err
    assert main(["fit", str(tmp_path / "nothere"), "--out", str(tmp_path / "g"), *QUICK]) == 2
    assert "nothere: expected a scene folder, found no such folder" in capsys.readouterr().err
    assert not (tmp_path / "g").exists()
    (tmp_path / "d").mkdir()
    with open(tmp_path / "d/.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert main(["fit", str(recorded), "--out", str(tmp_path / "d")]) == 2
    assert "a folder that no other fit uses" in capsys.readouterr().err


def test_the_folder_of_a_benchmark_is_refused(recorded: Path, tmp_path: Path, capsys) -> None:
    """A fit writes `predictions/` anew: those of methods and scenes in the same place would be gone."""
    of_a_run = tmp_path / "predictions/tfp+4dgs/toy/SHA256SUMS"
    of_a_run.parent.mkdir(parents=True)
    of_a_run.touch()
    assert main(["fit", str(recorded), "--out", str(tmp_path), *QUICK]) == 2
    assert "predictions: expected a new folder" in capsys.readouterr().err
    assert of_a_run.exists() and not (tmp_path / MODEL).exists()


def test_a_killed_fit_resumes(recorded: Path, tmp_path: Path, no_plots: None, capsys, monkeypatch) -> None:
    """A killed process leaves the files as they are: a copy from before the model is saved is such a folder."""
    whole, out, fit = tmp_path / "whole", tmp_path / "out", fit_module.timed_fit

    def copied(*arguments: Any) -> Any:
        made = fit(*arguments)
        if not out.exists():
            shutil.copytree(whole, out)
        return made

    monkeypatch.setattr(fit_module, "timed_fit", copied)
    arguments = ["fit", str(recorded), "--method", "tfp+static", *QUICK, "--out"]
    assert main([*arguments, str(whole)]) == 0
    (clock,) = out.glob("work/*/fit_clock.json")
    assert not (out / MODEL).exists() and "resuming after" not in capsys.readouterr().out
    shutil.copytree(clock.parent, out / "work/another")
    assert main([*arguments, str(out)]) == 0
    assert "resuming after" in capsys.readouterr().out and [p.name for p in (out / "work").iterdir()] == ["another"]
    assert same_model(out, whole)


def test_views_of_a_few_pixels_are_refused(tmp_path: Path) -> None:
    scene = write_small_scene(tmp_path / "scene", width=8, height=8)
    with pytest.raises(UserError, match="expected views of 16 pixels or more each way, found 8"):
        open_recording(scene)
