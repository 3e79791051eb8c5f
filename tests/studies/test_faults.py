"""What faults of an array cost: captures, fits and scores of a tiny scene, and the table of them."""

import csv
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from changes import edit_json, files_in
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio
from small_scenes import HEIGHT, WIDTH

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.runs.predictions import open_predictions, write_predictions
from spike4dgs.benchmark.scene.images import write_mask
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.cli import main
from spike4dgs.method.recordings import fit as fit_module
from spike4dgs.studies import faults as fault_table
from spike4dgs.studies.faults import CASES, Case, Outcome


def test_cases_have_folders_of_their_own_and_begin_without_a_fault() -> None:
    assert not CASES[0].worse and all(case.worse for case in CASES[1:])
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names) and all(name.replace("-", "").replace(".", "").isalnum() for name in names)


COMMAND = ["--methods", "tfp+static", "--budget", "0.01"]


@pytest.fixture(scope="module", autouse=True)
def _brief() -> Iterator[None]:
    """Ten frames of video, not 300, and a gray pixel for the sheet: each takes longer than the rest of a fit."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("FPS", "SLOW_FPS"):
            patch.setattr(fit_module, name, 1.0)
        patch.setattr(fit_module, "write_sheet", lambda path, *_: Image.new("L", (1, 1)).save(path))
        yield


@pytest.fixture(scope="module")
def exact(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The table of a capture without a fault."""
    out = tmp_path_factory.mktemp("exact") / "faults"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fault_table, "CASES", CASES[:1])
        assert main(["fault-table", str(tiny_data / "car-0-tiny"), *COMMAND, "--out", str(out)]) == 0
    return out


@pytest.fixture
def out(exact: Path, tmp_path: Path) -> Path:
    """The same folder, to be gone on with."""
    return Path(shutil.copytree(exact, tmp_path / "faults"))


def clipped(image: np.ndarray) -> np.ndarray:
    return np.clip(image.astype(np.float64), 0, 1)


def test_a_table_of_two_captures(tiny_data: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fault_table, "CASES", (CASES[0], Case("bad pixels", "9 a camera", {"bad_pixels": 9})))
    scene = tiny_data / "car-0-tiny"
    command = ["fault-table", str(scene), *COMMAND, "--out", str(out)]
    assert main(command) == 0
    with (out / "table.csv").open() as file:
        exact, worse = csv.DictReader(file)
    truth = open_scene(scene)
    seen = open_predictions(out / "fits" / "none" / "tfp+static" / "predictions", truth.targets)
    pairs = [(clipped(truth.ground_truth(t)), clipped(seen.read(t))) for t in truth.targets]
    by_hand = np.mean([peak_signal_noise_ratio(*pair, data_range=1) for pair in pairs])
    assert float(exact["psnr"]) == pytest.approx(by_hand, abs=1e-3) and float(exact["psnr_lost"]) == 0
    assert float(worse["psnr_lost"]) == pytest.approx(float(exact["psnr"]) - float(worse["psnr"]), abs=2e-4)
    assert not list((out / "captures" / "bad-pixels-9-a-camera").rglob("*.exr")), "it holds nothing of the truth"

    model = out / "fits" / "none" / "tfp+static" / "model.safetensors"
    before = model.stat().st_mtime_ns
    assert main(command) == 0
    assert model.stat().st_mtime_ns == before, "finished fits are kept"


def test_captures_of_another_scene_seed_or_budget_are_not_taken_for_these(
    tiny_data: Path, out: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fault_table, "CASES", CASES[:1])
    command = ["fault-table", str(tiny_data / "car-0-tiny"), *COMMAND, "--out", str(out)]
    before = files_in(out)
    for options, what in ((["--seed", "1"], "seed"), (["--budget", "1"], "budget")):
        assert main([*command, *options]) == 2
        assert f"expected captures and fits of this {what}, found those of another" in capsys.readouterr().err
    assert files_in(out) == before
    edit_json(out / "about.json", lambda about: about.update(scene="0" * 64))
    assert main(command) == 2 and "of this scene, found" in capsys.readouterr().err


def test_a_fit_that_was_refused_is_tried_again(tiny_data: Path, out: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(fault_table, "CASES", CASES[:1])
    kept = out / "fits/none/tfp+static/scores.json"
    kept.unlink()
    command = ["fault-table", str(tiny_data / "car-0-tiny"), *COMMAND, "--out", str(out)]
    with monkeypatch.context() as patch:
        patch.setattr(fault_table, "fit_recording", lambda *_: refuse())
        assert main(command) == 0
    assert "no weights" in (out / "table.csv").read_text() and not kept.exists()
    assert main(command) == 0 and kept.exists()


def test_scores_of_another_method_of_that_name_are_made_anew(tiny_data: Path, out: Path, monkeypatch) -> None:
    """Such as of one with other weights or settings."""
    monkeypatch.setattr(fault_table, "CASES", CASES[:1])
    kept = out / "fits/none/tfp+static/scores.json"
    before = json.loads(kept.read_text())
    edit_json(kept, lambda scores: scores.update(by="another", psnr=99.0))
    assert main(["fault-table", str(tiny_data / "car-0-tiny"), *COMMAND, "--out", str(out)]) == 0
    assert json.loads(kept.read_text()) == before


def refuse() -> None:
    raise UserError("no weights")


def test_rows_of_the_lens_show_the_scene_that_was_made_with_it(tiny_data, out: Path, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(fault_table, "CASES", CASES[:1])
    monkeypatch.setattr(fault_table, "LENS_CASES", (fault_table.LENS_CASES[-1],))
    curved = tmp_path / "curved"
    shutil.copytree(tiny_data / "car-0-tiny", curved)
    lens = {"k1": -0.2}
    for name in ("train", "test", "all"):
        file = curved / f"transforms_{name}.json"
        transforms = json.loads(file.read_text())
        file.write_text(json.dumps({**transforms, "frames": [f | lens for f in transforms["frames"]]}))
    write_manifest(curved)
    options = ["--lens-scene", str(curved), *COMMAND, "--out", str(out)]
    assert main(["fault-table", str(tiny_data / "car-0-tiny"), *options]) == 0
    clips = [open_scene(out / "captures" / name / "clip") for name in ("none", "lens-ignored")]
    assert all(not c.distortion for clip in clips for c in clip.cameras.values()), "the capture says pinhole"
    with (out / "table.csv").open() as file:
        exact, ignored = csv.DictReader(file)
    # The streams are those of the same pinholes: a fit that is told of no lens has the same score.
    assert (ignored["fault"], ignored["size"]) == ("lens", "ignored")
    assert float(ignored["psnr"]) == pytest.approx(float(exact["psnr"]), abs=1e-3)


def test_a_scene_in_which_nothing_moves_has_no_score_where_things_move(small_scene: Path, tmp_path: Path) -> None:
    for mask in small_scene.rglob("masks/*/*.png"):
        write_mask(mask, np.zeros((HEIGHT, WIDTH), bool))
    write_manifest(small_scene)
    scene = open_scene(small_scene)
    darker = {target: scene.ground_truth(target) - np.float32(0.1) for target in scene.targets}
    found = fault_table._scores(write_predictions(tmp_path / "predictions", scene, darker, "mine"), scene)
    assert found["psnr"] == pytest.approx(20, abs=0.1) and found["psnr_dynamic"] is None


def test_a_fit_that_fails_has_a_dash_and_its_reason(tmp_path: Path) -> None:
    worse = Case("poses", "1°", {"pose_deg": 1})
    found = [Outcome(CASES[0], "a", 30.0, 25.0), Outcome(worse, "a", None, None, "no points")]
    fault_table._write(tmp_path, found, {})
    text = (tmp_path / "table.md").read_text()
    assert "| none |  | 30.00 | 25.00 |" in text and "| poses | 1° | - | - |" in text
    assert text.endswith("- poses, 1°, a: no points\n")
