"""Files made to do harm, one test for each way: refused in one line, before anything is computed or written."""

import itertools
import json
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from memory import peak_bytes
from saved_models import model, provenance
from small_scenes import write_small_scene
from submissions import submit

from spike4dgs.benchmark import UserError, open_scene, score_predictions
from spike4dgs.benchmark.exchange.recording import Recording
from spike4dgs.benchmark.exchange.spikecv import import_spikecv
from spike4dgs.benchmark.files import MOST_BYTES, read_json
from spike4dgs.benchmark.json_values.text import parse_json
from spike4dgs.benchmark.metrics.measure import select_metrics
from spike4dgs.benchmark.runs.predictions import MethodInfo, PredictionInfo, PredictionWriter, open_predictions
from spike4dgs.benchmark.runs.record import check_record, read_record
from spike4dgs.benchmark.scene.images import read_exr, read_mask, read_png, write_exr, write_mask
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.spikes.folder import open_stream_folder
from spike4dgs.cli import main
from spike4dgs.method.models.saved_model import load_model

HUGE = "9" * 400


@pytest.fixture(scope="module")
def scored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene, predictions for it, and their record."""
    root = tmp_path_factory.mktemp("scored")
    scene = open_scene(write_small_scene(root / "scene"))
    with PredictionWriter(root / "predictions") as writer:
        for target in scene.targets:
            writer.add(target, scene.ground_truth(target), 0.0)
        writer.finish(PredictionInfo(MethodInfo("mine", params={"a": {"b": 1.5}}), scene.id, fit_seconds=1.0))
    record = score_predictions(root / "predictions", [scene], select_metrics().among(["psnr", "ssim"]))
    (root / "record.json").write_text(json.dumps(record))
    return root


def refused(act: Callable[[], Any], message: str) -> None:
    def attempt() -> None:
        with pytest.raises(UserError, match=message) as e:
            act()
        assert len(str(e.value).splitlines()) == 1 and len(str(e.value)) < 2000

    assert peak_bytes(attempt) < 100e6


# ---------------------------------------------------------------- JSON


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": 1, "a": 2}', "the key 'a' twice"),
        ('{"b": {"a": 1, "c": 3, "a": 2}}', "the key 'a' twice"),
        (f'{{"a": {HUGE}}}', "an integer of 400 digits"),
        ('{"a": 18446744073709551616}', "which 64 bits do not hold"),
        ('{"a": 1e400}', "too large for double precision"),
        ('{"a": NaN}', "NaN is no JSON number"),
        ('{"a": ' + "[" * 80 + "]" * 80 + "}", "nested more than 64 deep"),
        ('{"a": ' + "[" * 100_000, "nested too deep|damaged text"),
        ('{"a": "\\ud800"}', "surrogates not allowed"),
        (" " * (MOST_BYTES + 1), "16777216 bytes at most, found 16777217"),
    ],
    ids=range(10),
)
def test_json_that_readers_take_in_different_ways_or_not_at_all(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.json").write_text(text)
    refused(lambda: read_json(tmp_path / "a.json", "a file"), message)


def test_a_message_is_short_whatever_a_file_says(tmp_path: Path) -> None:
    (tmp_path / "stream.json").write_text(json.dumps({"schema": "x" * 1_000_000}))
    refused(lambda: open_stream_folder(tmp_path), "expected schema 'spike4dgs-streams/1', found 'xxx")


def test_json_is_otherwise_what_the_library_reads() -> None:
    text = '{"a": [1, 2.5, -3e2, true, null, "\\ud83d\\ude00 \\u00e4"], "b": {"a": 18446744073709551615}, "c": []}'
    assert parse_json(text) == json.loads(text)
    assert parse_json("3") == 3 and parse_json("[" * 63 + "]" * 63) is not None


# ---------------------------------------------------------------- records and predictions


def put(record: dict[str, Any], path: str, value: Any) -> None:
    *keys, last = (key.replace("|", "/") for key in path.split("/"))
    for key in keys:
        record = record[key]
    record[last] = value


CELL = "scenes/pattern-0/"
IMAGE = "per_image/cam_03|000020/psnr"


FIELDS = ("fit_seconds", "render_fps", "gain_aligned", "metrics/psnr", IMAGE)
NO_NUMBERS = (HUGE, "-1e400", "Infinity", "NaN", "true", "[1]")  # of any field: the text of a number is no number


@pytest.mark.parametrize(
    ("field", "value"),
    [*itertools.product(FIELDS, ("1e308", "-1e308", "1e13", '"1"')), *itertools.product(FIELDS[-1:], NO_NUMBERS)],
)
def test_numbers_of_records(scored: Path, tmp_path: Path, field: str, value: str) -> None:
    record = json.loads((scored / "record.json").read_text())
    cell = record["scenes"]["pattern-0"]
    put(cell, field, "VALUE")
    (tmp_path / "record.json").write_text(json.dumps(record).replace('"VALUE"', value))
    refused(lambda: read_record(tmp_path / "record.json"), "damaged text|a valid spike4dgs-result/1, found at scenes")


@pytest.mark.parametrize(
    ("path", "value"),
    [
        *(("dataset/name", name) for name in ("../../outside", "..", "a/b", "a+../b")),
        *(("dataset/split", name) for name in ("../x", "center\n")),
        *(("method/name", name) for name in ("../x", "mine\n")),
        *(("harness/commit", text) for text in ("not a commit", "0" * 39)),
        ("method/seed", 2**70),
        ("environment/cpu", "x" * 1000),
        ("dataset/scenes", {"../x": "0" * 64}),
        (CELL + "per_image", {"../../x": {}}),
        (CELL + "fit_seconds", -1),
    ],
)
def test_names_and_facts_of_records(scored: Path, path: str, value: Any) -> None:
    record = json.loads((scored / "record.json").read_text())
    put(record, path, value)
    refused(lambda: check_record(record, "here"), "expected a valid spike4dgs-result/1")


@pytest.mark.parametrize("path", ["dataset/name", "dataset/split", "method/name"])
def test_a_record_whose_name_leads_elsewhere_is_not_submitted(scored: Path, tmp_path: Path, path: str) -> None:
    record = json.loads((scored / "record.json").read_text())
    put(record, path, "../../outside")
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "record.json").write_text(json.dumps(record))
    refused(lambda: submit(tmp_path / "in/record.json", leaderboard=tmp_path / "in/board"), "record.json")
    assert [p.name for p in tmp_path.iterdir()] == ["in"] and not list((tmp_path / "in").rglob("entries/*"))


def test_a_refused_claim_leaves_the_leaderboard_as_it_was(scored: Path, tmp_path: Path) -> None:
    board, claim = tmp_path / "board", tmp_path / "claim.json"
    submit(scored / "record.json", leaderboard=board)
    before = {p: p.read_bytes() for p in board.rglob("*.json")}
    claim.write_text((scored / "record.json").read_text().replace('"fit_seconds": 1.0', f'"fit_seconds": 1{"0" * 400}'))
    refused(lambda: submit(claim, leaderboard=board, replace=True), "an integer of 401 digits")
    assert read_record(scored / "record.json") == json.loads((scored / "record.json").read_text())
    submit(scored / "record.json", leaderboard=board)
    assert {p: p.read_bytes() for p in board.rglob("*.json")} == before


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"fit_seconds": 1.0', '"fit_seconds": 1e400'),
        ('"fit_seconds": 1.0', f'"fit_seconds": {"9" * 400}'),
        ('"fit_seconds": 1.0', '"fit_seconds": 1e308'),
        ('"b": 1.5', '"b": 1e400'),
        ('"b": 1.5', f'"b": {"9" * 400}'),
        ('"b": 1.5', '"b": ' + "[" * 200 + "]" * 200),
        ('"name": "mine"', '"name": "../mine"'),
        ('"scene": "pattern-0"', '"scene": "../pattern-0"'),
        ('"scene": "pattern-0"', '"scene": "pattern-0", "scene": "pattern-1"'),
    ],
)
def test_descriptions_of_predictions(scored: Path, tmp_path: Path, old: str, new: str) -> None:
    text = (scored / "predictions/prediction.json").read_text()
    assert old in text
    (tmp_path / "prediction.json").write_text(text.replace(old, new))
    refused(lambda: open_predictions(tmp_path, ()), "prediction.json")


def test_sums_of_other_files_are_not_looked_at(scored: Path, tmp_path: Path) -> None:
    (tmp_path / "prediction.json").write_bytes((scored / "predictions/prediction.json").read_bytes())
    (tmp_path / "SHA256SUMS").write_text(f"{'0' * 64}  ../../secret.exr\n")
    refused(lambda: open_predictions(tmp_path, ()), "1 extra: ../../secret.exr")


# ---------------------------------------------------------------- scenes


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    facts = {"flat_radiance": 0.5, "flat_ticks": 4}
    return write_small_scene(tmp_path_factory.mktemp("calibrated") / "scene", extras={"calibration": facts})


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("scene.json", "cam_03", "../cam_03"),
        ("scene.json", "cam_03", "CAM_02"),
        ("scene.json", "spikes/cam_00.dat", "../../secret.dat"),
        ("scene.json", "spikes/cam_00.dat", "/etc/passwd"),
        ("scene.json", '"id": "pattern-0"', '"id": ".."'),
        ("scene.json", '"n_ticks": 80', f'"n_ticks": {HUGE}'),
        ("scene.json", '"n_ticks": 80', '"n_ticks": 1e308'),
        ("scene.json", '"width": 40', '"width": 36000'),
        ("scene.json", '"rate_hz": 20000.0', '"rate_hz": 1e308'),
        ("scene.json", '"flat_radiance": 0.5', '"flat_radiance": "bright"'),
        ("scene.json", '"flat_ticks": 4', '"flat_ticks": 1e400'),
        ("targets.json", '"tick": 20', f'"tick": {HUGE}'),
        ("targets.json", '"tick": 20', '"tick": 1e400'),
        ("targets.json", '"tick": 20', '"tick": 1e308'),
        ("targets.json", "cam_03", "../cam_03"),
        ("transforms_train.json", '"fl_x": 48.0', '"fl_x": 1e308'),
        ("transforms_train.json", '"fl_x": 48.0', f'"fl_x": {HUGE}'),
        ("transforms_train.json", '"w": 40', '"w": 1e308'),
        ("transforms_train.json", '"camera": "cam_00"', '"camera": "../cam_00"'),
        ("transforms_train.json", '"transform_matrix": [', '"transform_matrix": [[1e308, 0, 0, 0],'),
    ],
)
def test_scenes_whose_facts_do_harm(calibrated: Path, tmp_path: Path, name: str, old: str, new: str) -> None:
    """A scene whose file `name` has another text; its manifest agrees."""
    root = Path(shutil.copytree(calibrated, tmp_path / "scene"))
    text = (root / name).read_text()
    assert old in text
    (root / name).write_text(text.replace(old, new))
    write_manifest(root)
    refused(lambda: open_scene(root), f"{name}|cam_03|camera")
    assert main(["verify", str(root)]) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]


def test_folders_of_streams_and_of_spikecv(tmp_path: Path) -> None:
    (tmp_path / "secret.dat").write_bytes(bytes(120))
    cam = {"file": "../secret.dat", "width": 40, "height": 24, "rate_hz": 2e4, "rows_bottom_up": True, "n_ticks": 1}
    (tmp_path / "in").mkdir()
    (tmp_path / "in/stream.json").write_text(json.dumps({"schema": "spike4dgs-streams/1", "streams": {"cam": cam}}))
    refused(lambda: open_stream_folder(tmp_path / "in"), "expected a path inside in, found '../secret.dat'")
    (tmp_path / "cv").mkdir()
    (tmp_path / "cv/config.yaml").write_text("filename: ../secret.dat\nspike_w: 40\nspike_h: 24\n")
    refused(lambda: import_spikecv(tmp_path / "cv", tmp_path / "out", Recording(2e4)), "expected a path inside cv")
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------- images


def with_window(path: Path, width: int, height: int) -> Path:
    """The image, whose header states another size."""
    data = bytearray(path.read_bytes())
    for name in (b"dataWindow", b"displayWindow"):
        at = data.index(name + b"\0box2i\0") + len(name) + 11
        data[at : at + 16] = struct.pack("<4i", 0, 0, width - 1, height - 1)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("size", [(36000, 36000), (16385, 1), (16384, 16384), (2**31 - 1, 2), (0, 5), (-3, 5)])
def test_an_exr_is_not_decoded_before_its_size_is_known(tmp_path: Path, size: tuple[int, int]) -> None:
    write_exr(tmp_path / "a.exr", np.ones((24, 40), np.float32), 0.0)
    refused(lambda: read_exr(tmp_path / "a.exr", (24, 41)), "expected an image of 41x24 pixels, found 40x24")
    refused(lambda: read_exr(with_window(tmp_path / "a.exr", *size)), "a.exr: expected an")


def write_windows(path: Path, **windows: tuple[tuple[int, int], tuple[int, int]]) -> None:
    """Write 40x24 pixels with other windows."""
    import OpenEXR

    named = {name: tuple(np.array(corner, np.int32) for corner in corners) for name, corners in windows.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **named}
    OpenEXR.File(header, {"Y": np.ones((24, 40), np.float16)}).write(str(path))


@pytest.mark.parametrize(
    "windows",
    [
        {"dataWindow": ((3, 5), (42, 28)), "displayWindow": ((0, 0), (39, 23))},
        {"dataWindow": ((3, 5), (42, 28)), "displayWindow": ((3, 5), (42, 28))},
        {"dataWindow": ((0, 0), (39, 23)), "displayWindow": ((0, 0), (799, 599))},
        {"dataWindow": ((0, 0), (39, 23)), "displayWindow": ((10, 0), (39, 23))},
    ],
)
def test_an_exr_whose_pixels_belong_elsewhere(tmp_path: Path, windows: dict[str, Any]) -> None:
    write_windows(tmp_path / "a.exr", dataWindow=((0, 0), (39, 23)), displayWindow=((0, 0), (39, 23)))
    assert read_exr(tmp_path / "a.exr", (24, 40)).shape == (24, 40)
    write_windows(tmp_path / "a.exr", **windows)
    message = r"expected a data window and a display window from \(0, 0\) to \(39, 23\), found \(.*; write the image"
    refused(lambda: read_exr(tmp_path / "a.exr", (24, 40)), message)


@pytest.mark.parametrize(
    ("channels", "side", "message"),
    [
        (1000, 24, "expected an image of at most 16 channels, found 1000"),
        (16, 2900, "samples in all its channels, found 134560000"),
    ],
)
def test_an_exr_of_many_channels(tmp_path: Path, channels: int, side: int, message: str) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    images = {f"c{i}": np.ones((24, 24), np.float16) for i in range(channels)}
    OpenEXR.File(header, images).write(str(tmp_path / "a.exr"))
    refused(lambda: read_exr(with_window(tmp_path / "a.exr", side, side)), message)


@pytest.mark.parametrize("size", [(36000, 36000), (16384, 16384), (2**31 - 1, 1), (0, 0)])
@pytest.mark.parametrize("read", [read_mask, read_png])
def test_a_png_is_not_decoded_before_its_size_is_known(tmp_path: Path, size: tuple[int, int], read: Any) -> None:
    write_mask(tmp_path / "a.png", np.ones((24, 40), bool))
    data = (tmp_path / "a.png").read_bytes()
    header = data[12:16] + struct.pack(">II", *size) + data[24:29]
    (tmp_path / "a.png").write_bytes(data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:])
    refused(lambda: read(tmp_path / "a.png"), "a.png: expected a")
    write_mask(tmp_path / "b.png", np.ones((24, 40), bool))
    refused(lambda: read(tmp_path / "b.png", (25, 40)), "expected an image of 40x25 pixels, found 40x24")


# ---------------------------------------------------------------- models


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("hexplane", '"settings": {', '"settings": "all", "old": {', "AttributeError|ValueError|TypeError"),
        ("hexplane", '"mlp_width": 8', '"mlp_width": 4000', "in place of"),
        ("hexplane", '"levels": 2', '"levels": 60', "one that this version cannot read"),
        ("hexplane", '"levels": 2', '"levels": 1000000000000', "is no number from 0 to 4096"),
        ("hexplane", '"cell_px": 3.0', '"cell_px": 1e-300', "one that this version cannot read"),
        ("hexplane", '"pieces": 1', '"pieces": 1000000000', "is no number from 1 to"),
        ("hexplane", '"n_ticks": 100, "scale"', '"n_ticks": 1e308, "scale"', "is no number from 1 to"),
        ("static", '"fit_seconds": 1.5', '"fit_seconds": 1e308', "at fit_seconds"),
        ("static", '"radiance_gain"', '"radiance_gain": 1, "radiance_gain"', "the key 'radiance_gain' twice"),
        ("static", '"camera": "', '"camera": "../', "does not match"),
        ("radiance-field", '"depth": 3', '"depth": 1000000000', "is no number from 0 to 64"),
        ("radiance-field", '"fine_samples": 4', '"fine_samples": 1000000000', "is no number|in place of"),
    ],
)
def test_texts_of_model_files(tmp_path: Path, name: str, old: str, new: str, message: str) -> None:
    from spike4dgs.method.models.model_file import read_tensors, write_tensors

    path = tmp_path / "a.safetensors"
    model(name).save(path, provenance())
    tensors, meta = read_tensors(path, "spike4dgs-model/1", "about", "a model", "")
    if name == "radiance-field" and "fine_samples" in old:
        old = '"fine_samples": ' + meta["about"].partition('"fine_samples": ')[2].partition(",")[0].rstrip("}")
    assert old in meta["about"], meta["about"]
    write_tensors(path, tensors, "spike4dgs-model/1", {"about": meta["about"].replace(old, new)}, "about")
    refused(lambda: load_model(path), message)


# ---------------------------------------------------------------- the command line


@pytest.mark.parametrize(
    "command",
    [
        "record --emulate SCENE --out OUT --seconds nan",
        "record --emulate SCENE --out OUT --seconds inf",
        "record --emulate SCENE --out OUT --seconds 1e300",
        "record --emulate SCENE --out OUT --seconds 1e11",
        "record --emulate SCENE --out OUT --worse.gain nan",
        "make-dataset car --out OUT --seconds nan",
        "make-dataset car --out OUT --seconds 1e11",
        "board-clip --out OUT --seconds nan",
        "board-clip --out OUT --seconds 1e12",
        "board-clip --out OUT --square-m inf",
        "import-dat SCENE --width 40 --height 24 --rate-hz nan --out OUT",
        "import-dat SCENE --width 100000000 --height 1 --rate-hz 1 --out OUT",
        "import-spikecv SCENE --rate-hz inf --out OUT",
        "inspect SCENE --rate-hz nan",
        "fit SCENE --out OUT --budget nan",
        "fit SCENE --out OUT --budget 1e300",
        "speed record --seconds nan",
        "speed record --disk-seconds inf",
    ],
)
def test_command_lines(one_small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str) -> None:
    arguments = command.replace("SCENE", str(one_small_scene)).replace("OUT", str(tmp_path / "out")).split()
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    assert not (tmp_path / "out").exists()
