"""`speed images`: every image maker is timed and scored; one that cannot run says why."""

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from small_scenes import GAIN, HEIGHT, WIDTH, add_gap, array_cameras, lose_ticks, write_small_scene

from spike4dgs.baselines.images.table import IMAGES, ImageMaker
from spike4dgs.baselines.images.tfp import TFP
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.scene.calibration import estimate
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.spikes.repair import fill_gaps
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.cli import main
from spike4dgs.generators.sensor import calibration as calibration
from spike4dgs.generators.sensor.calibration import dark_map, gain_map
from spike4dgs.generators.sensor.model import Sensor
from spike4dgs.method.settings import Settings
from spike4dgs.studies import images
from spike4dgs.studies.kit.timing import show_table
from spike4dgs.studies.speed_error.images import held_out


def needs_weights(stream: SpikeStream, tick: int, settings: Settings) -> np.ndarray:
    raise problem("net.safetensors", "weights", "no such file", "train them")


def use(monkeypatch: pytest.MonkeyPatch, makers: dict[str, ImageMaker]) -> None:
    """Compare these makers, and time them on a small stream."""
    for name, value in {"IMAGES": makers, "WIDTH": 40, "HEIGHT": 24, "TICKS": 60}.items():
        monkeypatch.setattr(images, name, value)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Two scenes, and an image maker without its weights; yields the output."""
    tmp_path = tmp_path_factory.mktemp("speed")
    makers = {name: IMAGES[name] for name in ("tfp", "tfi", "tfstp")}
    with pytest.MonkeyPatch.context() as monkeypatch:
        absent = ImageMaker(name="spk2img", definition="", source="", rate=needs_weights)
        use(monkeypatch, {**makers, "spk2img": absent})
        scenes = [str(write_small_scene(tmp_path / f"s{i}", seed=i)) for i in range(2)]
        assert main(["speed", "images", *scenes, "--repeats", "1", "--out", str(tmp_path / "out")]) == 0
        yield tmp_path / "out"


def read_rows(path: Path, key: str = "images") -> dict[str, dict[str, str]]:
    with open(path) as f:
        return {row[key]: row for row in csv.DictReader(f)}


def test_each_maker_has_a_row_with_times_scores_and_the_papers_numbers(measured: Path) -> None:
    table = read_rows(measured / "images.csv")
    assert list(table) == ["tfp", "tfi", "tfstp", "spk2img"]
    for name in ("tfp", "tfi", "tfstp"):
        assert all(float(table[name][c]) > 0 for c in ("ms 40x24", "PSNR", "SSIM", "PSNR, moving")), name
    published = [(row["in Table 6"], row["its PSNR"], row["its SSIM"]) for row in table.values()]
    assert published[:2] == [("TFP", "25.37", "0.852"), ("TFI", "24.51", "0.850")]
    assert published[2:] == [("TVS", "22.43", "0.821"), ("Spike2img", "30.76", "0.904")]
    assert "stands in for TVS" in table["tfstp"]["note"]
    absent = table["spk2img"]
    assert absent["note"] == "net.safetensors: expected weights, found no such file; train them"
    assert {absent[c] for c in ("ms 40x24", "PSNR", "SSIM", "PSNR, moving")} == {"-"}


def test_scores_are_those_of_the_held_out_streams_images(measured: Path) -> None:
    by_scene = read_rows(measured / "images_by_scene.csv", "scene")
    psnr, ssim = [], []
    for i in range(2):
        scene = open_scene(measured.parent / f"s{i}")
        shown = [(scene.ground_truth(t), TFP(scene.stream("cam_03"), [t.tick], GAIN)[0]) for t in scene.targets]
        pairs = [np.clip(pair, 0, 1).astype(float) for pair in shown]
        psnr.append(np.mean([peak_signal_noise_ratio(*pair, data_range=1) for pair in pairs]))
        options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1}
        ssim.append(np.mean([structural_similarity(*pair, **options) for pair in pairs]))
        assert float(by_scene[scene.id]["tfp"]) == pytest.approx(psnr[-1], abs=0.006)
    row = read_rows(measured / "images.csv")["tfp"]
    assert float(row["PSNR"]) == pytest.approx(np.mean(psnr), abs=0.006)
    assert float(row["SSIM"]) == pytest.approx(np.mean(ssim), abs=6e-5)
    assert row["PSNR, corrected"] == "-"


def test_images_are_scored_again_where_the_camera_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use(monkeypatch, {})
    for camera in array_cameras():
        pixels = camera.height, camera.width, 0, camera.id
        sensor = Sensor(gain=gain_map(*pixels), dark=dark_map(*pixels))
        calibration.write_calibration(tmp_path / "s/calibration", camera, sensor, [1])
    facts = {"flat_radiance": 0.7, "flat_ticks": calibration.FLAT_TICKS, "dark_ticks": calibration.DARK_TICKS}
    scene = open_scene(write_small_scene(tmp_path / "s", extras={"calibration": facts}))
    row = images.measure_maker("tfp", TFP, [scene], 1)
    known, expected = scene.recordings("cam_03"), []
    assert known is not None
    camera = estimate(known)
    for target in scene.targets:
        rate = TFP(scene.stream("cam_03"), [target.tick], 1.0)[0]
        light = np.clip((rate - camera.dark) / camera.gain / camera.radiance_gain, 0, 1).astype(float)
        truth = np.clip(scene.ground_truth(target).astype(float), 0, 1)
        expected.append(peak_signal_noise_ratio(truth, light, data_range=1))
    found = images.mean_over_scenes(row.corrected, "psnr")
    assert found == pytest.approx(np.mean(expected), abs=1e-3)
    assert found != pytest.approx(images.mean_over_scenes(row.quality, "psnr"), abs=0.01)
    without = open_scene(write_small_scene(tmp_path / "t", seed=1))
    assert not images.measure_maker("tfp", TFP, [scene, without], 1).corrected, "no mean over fewer scenes beside one"


def test_a_strip_of_images_for_each_scene(measured: Path) -> None:
    for i in range(2):
        with Image.open(measured / f"strip_pattern-{i}.png") as strip:
            assert strip.width > 4 * WIDTH and strip.height > 2 * HEIGHT
            pixels = np.asarray(strip.convert("L"))
        assert pixels.std() > 20, "there are images in it"


def test_without_scenes_only_time_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use(monkeypatch, {"tfp": TFP})
    assert images.images(repeats=1, out=tmp_path) == 0
    row = read_rows(tmp_path / "images.csv")["tfp"]
    assert float(row["ms 40x24"]) > 0 and row["PSNR"] == row["ms, scene"] == "-"
    assert not list(tmp_path.glob("*.png"))


def test_a_scene_without_ground_truth_is_refused(small_scene: Path) -> None:
    scene = open_scene(small_scene)
    object.__setattr__(scene, "targets", ())
    with pytest.raises(UserError, match="expected a scene with targets, found none in targets.json"):
        images.middle_target(scene)


def test_gaps_are_refused_unless_allowed(small_scene: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    add_gap(small_scene, "cam_00", 3, 2)
    use(monkeypatch, {"tfp": TFP})
    command = ["speed", "images", str(small_scene), "--out", str(tmp_path)]
    assert main(command) == 2
    assert "pass --allow-gaps" in capsys.readouterr().err
    assert main([*command, "--allow-gaps"]) == 0


def test_lost_ticks_are_no_darkness(small_scene: Path) -> None:
    target = open_scene(small_scene).targets[1]
    lose_ticks(small_scene, target.camera, target.tick - 8, 6)
    scene = open_scene(small_scene, allow_gaps=True)
    stream, tick, gain = held_out(scene, target)
    filled = fill_gaps(scene.stream(target.camera))
    assert np.array_equal(TFP(stream, [tick], gain), TFP(filled, [tick], gain))


def test_notes_stand_below_the_table_and_in_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    show_table("title", ("name", "ms"), [("a", "1"), ("b", "2")], tmp_path / "t.csv", ["", "why"])
    assert "\nb: why\n" in capsys.readouterr().out
    assert (tmp_path / "t.csv").read_text().splitlines() == ["name,ms,note", "a,1,", "b,2,why"]
    show_table("title", ("name", "ms"), [("a", "1")], tmp_path / "t.csv")
    assert (tmp_path / "t.csv").read_text().splitlines() == ["name,ms", "a,1"]
