"""What an interpreter and a notebook show of public objects."""

import base64
import importlib
import io
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dummy_methods import CountMethod, run
from PIL import Image

from spike4dgs.benchmark import Scene, UserError, open_scene, open_stream, read_record, score_predictions
from spike4dgs.benchmark.method import FitRequest, find_methods
from spike4dgs.benchmark.runs.predictions import open_predictions, write_predictions
from spike4dgs.benchmark.screen.shown import MOST, Table

ROOMS = ("benchmark", "generators", "method", "baselines", "leaderboard")


@pytest.fixture
def scene(small_scene: Path) -> Scene:
    return open_scene(str(small_scene))


def images_in(html: str) -> list[Image.Image]:
    found = re.findall(r"data:image/jpeg;base64,([^\"]+)", html)
    return [Image.open(io.BytesIO(base64.b64decode(data))) for data in found]


def test_every_public_object_has_a_short_repr(scene: Scene) -> None:
    rooms = [importlib.import_module(f"spike4dgs.{room}") for room in ROOMS]
    objects: list[Any] = [getattr(room, name) for room in rooms for name in room.__all__]
    tables = [o for o in objects if isinstance(o, Table)]
    methods = find_methods()
    objects += [value for table in tables for value in table.values()] + [methods, *methods.values()]
    objects += [scene, scene.training, scene.cameras, scene.manifest, FitRequest(), scene.targets[0]]
    objects += [scene.stream(scene.train[0]), *scene.cameras.values(), *scene.targets]
    assert len(tables) >= 5
    assert {repr(o)[:60]: len(repr(o)) for o in objects if len(repr(o)) > MOST} == {}
    assert "object at 0x" not in " ".join(map(repr, [*objects[-9:], *methods.values()]))


def test_a_scene_shows_its_truth_and_its_spikes(scene: Scene) -> None:
    camera = scene.cameras[scene.test[0]]
    images = images_in(scene._repr_html_())
    assert len(images) == 1 + min(3, len(scene.train)) and all(i.size == (camera.width, camera.height) for i in images)
    truth = scene.ground_truth(scene.targets[len(scene.targets) // 2])
    assert np.corrcoef(np.asarray(images[0]).ravel(), np.sqrt(truth).ravel())[0, 1] > 0.9
    assert len(images_in(scene.training._repr_html_())) == min(4, len(scene.train))


def test_a_stream_opens_by_a_string_and_shows_its_rates(scene: Scene) -> None:
    own = scene.stream(scene.train[0])
    stream = open_stream(str(own.source), own.width, own.height, own.rate_hz)
    assert repr(stream).startswith(f"<SpikeStream {Path(own.source).name}: {own.width}x{own.height} pixels, ")
    (image,) = images_in(stream._repr_html_())
    rate = own.counts(0, own.n_ticks).astype(float)
    assert np.corrcoef(np.asarray(image).ravel(), np.sqrt(rate).ravel())[0, 1] > 0.8


def test_a_damaged_file_is_said_in_the_card(scene: Scene) -> None:
    (scene.root / f"images/{scene.targets[len(scene.targets) // 2].name}.exr").write_bytes(b"damaged")
    assert "expected" in scene._repr_html_()


def test_a_record_shows_its_scores(small_scene: Path, tmp_path: Path) -> None:
    run(tmp_path, [small_scene], CountMethod("counts"), metrics=("psnr",))
    record = read_record(str(tmp_path / "results/counts.json"))
    assert repr(record).startswith(f"<Record counts, seed 0: 1 scene, psnr {record['mean']['psnr']:.2f}, ssim ")
    assert f"<td>{record['mean']['psnr']:.2f}</td>" in record._repr_html_() and {**record} == record


def test_a_table_of_names_travels() -> None:
    table = pickle.loads(pickle.dumps(Table("metrics", {"psnr": 1, "ssim": 2})))
    assert repr(table) == "<2 metrics: psnr, ssim>" and table == {"psnr": 1, "ssim": 2}


def test_images_of_any_program_become_predictions(scene: Scene, tmp_path: Path) -> None:
    truths = {t: scene.ground_truth(t) for t in scene.targets}
    folder = write_predictions(str(tmp_path / "mine"), scene, truths, "perfect", fit_seconds=3.0)
    open_predictions(folder, scene.targets).verify()
    record = score_predictions(folder, [scene])
    assert record["mean"]["psnr"] == 100.0 and record["scenes"][scene.id]["fit_seconds"] == 3.0
    assert write_predictions(folder, scene.root, truths, "again") == folder


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, images: images.pop(t), "the scene's targets, found 1 missing"),
        (lambda t, images: images.update({t: images[t][1:]}), "expected finite radiance"),
        (lambda t, images: images.update({t: images[t] * np.nan}), "NaN or infinity"),
    ],
)
def test_images_that_are_none_are_refused(scene: Scene, tmp_path: Path, change: Any, message: str) -> None:
    images = {t: scene.ground_truth(t) for t in scene.targets}
    change(scene.targets[0], images)
    with pytest.raises(UserError, match=message):
        write_predictions(tmp_path / "mine", scene, images, "mine")
    assert not (tmp_path / "mine").exists()


def test_predictions_never_replace_other_files(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other/notes.txt").write_text("mine")
    with pytest.raises(UserError, match="a new folder, or earlier predictions, found something else"):
        write_predictions(tmp_path / "other", scene, {t: scene.ground_truth(t) for t in scene.targets}, "mine")
