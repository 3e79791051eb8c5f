"""Oracles in a world whose truth is a formula: each part that they replace is the truth, and nothing else is."""

import csv
import pickle
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from changes import edit_json
from toy_world import GAIN, ToyWorld

from spike4dgs.baselines.recipes import INITIALIZATIONS, PARTS
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.method import Budget, FitRequest, find_methods
from spike4dgs.benchmark.runs.record import read_record
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.cli import main
from spike4dgs.method.gaussians.parameters import from_points
from spike4dgs.method.images.training import ImageSettings, choose_ticks, make_training_images
from spike4dgs.method.motion.base import Extent
from spike4dgs.method.starts.base import StartRequest
from spike4dgs.method.training_views.pinholes import as_pinholes
from spike4dgs.studies import oracle_methods as oracle
from spike4dgs.studies.oracle_methods import (
    RUNGS,
    OracleMethod,
    TrueImages,
    oracle_ladders,
    true_points,
)
from spike4dgs.studies.oracle_truth import Surfaces, Truth

METHODS = find_methods()

WORLD = ToyWorld(width=48, height=30, n_ticks=240, side=2)
SCENE, SAMPLES = WORLD.training, 64
TICKS = choose_ticks(SCENE.n_ticks, ImageSettings())


def write(path: Path, **arrays: np.ndarray) -> None:
    with atomic_path(path) as part:
        np.savez(part, allow_pickle=False, **arrays)


def true_surfaces() -> Surfaces:
    """A point for each pixel of the training cameras, in the middle of the clip, with the board's velocity."""
    points, values, velocities = [], [], []
    for camera in SCENE.cameras:
        image, depth, board = WORLD.trace(camera, 0.5)
        v, u = np.mgrid[: camera.height, : camera.width].reshape(2, -1)
        points.append(camera.unproject(np.stack([u, v], -1) + 0.5, depth[v, u]))
        values.append(image[v, u])
        velocities.append(board[v, u][:, None] * [WORLD.travel / (SCENE.duration_us * 1e-6), 0.0, 0.0])
    return Surfaces(*(np.concatenate(parts).astype(np.float32) for parts in (points, values, velocities)))


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("truths")
    truth, found = Truth.of(folder, SCENE.id, SCENE.revision, SAMPLES), true_surfaces()
    for tick in TICKS:
        frames = [WORLD.trace(camera, tick / SCENE.n_ticks)[0] for camera in SCENE.cameras]
        write(truth.image_file(tick), images=np.stack(frames).astype(np.float32))
    write(truth.surfaces_file, points=found.points, values=found.values, velocities=found.velocities)
    shape = len(SCENE.cameras), WORLD.height, WORLD.width
    gain = np.random.default_rng(0).uniform(0.8, 1.2, shape).astype(np.float32)
    write(truth.sensors_file, gain=gain, dark=np.full(shape, 0.01, np.float32))
    return folder


@pytest.fixture
def truth(root: Path) -> Truth:
    return Truth.of(root, SCENE.id, SCENE.revision, SAMPLES)


def test_the_images_of_a_fit_are_the_true_ones(truth: Truth) -> None:
    make = TrueImages(truth=truth, streams=SCENE.streams)
    images = make_training_images(SCENE, SCENE.cameras, make, ImageSettings(), "cpu")
    assert images.ticks == TICKS
    for camera, found in zip(SCENE.cameras, images.images[3:5].transpose(0, 1), strict=True):
        expected = np.stack([WORLD.trace(camera, t / SCENE.n_ticks)[0] for t in TICKS[3:5]])
        assert found.numpy() == pytest.approx(expected, abs=1e-6)


def test_true_first_points_lie_on_the_surfaces_and_are_as_dense_as_those_of_rig(truth: Truth) -> None:
    settings: Any = INITIALIZATIONS["rig"].settings
    start = true_points(truth.surfaces(), StartRequest(SCENE, 0, settings))
    assert start.cameras == SCENE.cameras
    x, y, z = start.points.astype(np.float64).T
    off = np.min([np.abs(z), np.abs(y - 1.0), np.abs(y)], axis=0)  # of floor, wall and board
    assert (off < 1e-5).mean() > 0.85, "the rest fills the border that no camera's pixel is on"
    of_pixels = np.isin(start.points.view([("", np.float32)] * 3), truth.surfaces().points.view([("", np.float32)] * 3))
    assert (off[of_pixels[:, 0]] < 1e-5).all() and of_pixels.mean() > 0.8
    own = INITIALIZATIONS["rig"].start(StartRequest(SCENE, 0, settings))
    assert 0.5 < len(start.points) / len(own.points) < 2


def test_first_gaussians_move_as_the_surfaces_that_they_lie_on(truth: Truth) -> None:
    known = oracle.paths_that_know(oracle.nearest_velocities(truth.surfaces()), SCENE.duration_us * 1e-6)
    extent = Extent(torch.zeros(3), torch.ones(3), 1.0, SCENE.n_ticks, WORLD.width)
    motion = known(extent, PARTS.motion["paths"].defaults, torch.Generator())
    board = np.array([[0.1, 0.0, 0.6], [-0.3, 0.0, 0.5]], np.float32)
    still = np.array([[0.2, 1.0, 1.4], [-0.9, 0.3, 0.0], [0.1, 0.99, 1.3]], np.float32)
    points = np.concatenate([board, still])
    plain = from_points(points, np.full(5, 0.5, np.float32), opacity=0.5, scale=1.0)
    first = motion.initialize(plain, None)  # type: ignore[arg-type]
    at_the_ends = [motion.splats(first, t).means.detach().numpy() for t in (0.0, 0.5, 1.0)]
    moved = [[WORLD.travel * (t - 0.5), 0, 0] for t in (0.0, 0.5, 1.0)]
    for found, by in zip(at_the_ends, moved, strict=True):
        assert found[:2] == pytest.approx(board + by, abs=1e-4) and found[2:] == pytest.approx(still, abs=1e-6)


def test_velocities_are_shared_out_over_the_pieces_of_a_long_clip(truth: Truth) -> None:
    known = oracle.paths_that_know(oracle.nearest_velocities(truth.surfaces()), SCENE.duration_us * 1e-6)
    extent = Extent(torch.zeros(3), torch.ones(3), 1.0, 1200, WORLD.width)
    motion = known(extent, PARTS.motion["paths"].defaults, torch.Generator())
    assert motion.pieces == 3
    point = from_points(np.array([[0.1, 0, 0.6]] * 4, np.float32), np.ones(4, np.float32), opacity=0.5, scale=1.0)
    first = motion.initialize(point, None)  # type: ignore[arg-type]
    ends = [motion.splats(first, t).means[0, 0].item() for t in (0.0, 1.0)]
    assert ends[1] - ends[0] == pytest.approx(WORLD.travel / 3, rel=1e-4)


def test_true_calibrations_take_the_place_of_estimates(truth: Truth) -> None:
    given = replace(SCENE, known_calibrations=truth.calibrations(GAIN))
    assert SCENE.calibrations is None and given.calibrations is not None
    camera: Calibration = given.calibrations[1]
    bent = replace(given, cameras=tuple(replace(c, distortion=(-0.1, 0, 0, 0, 0)) for c in given.cameras))
    for copy in (replace(given, cameras=given.cameras[::-1]), as_pinholes(bent)):  # as fits with poses and lenses make
        assert copy.calibrations is not None and copy.calibrations[1].gain is camera.gain
    radiance = np.full((WORLD.height, WORLD.width), 0.4, np.float32)
    assert camera.radiance(GAIN * camera.gain * radiance + camera.dark) == pytest.approx(radiance, abs=1e-6)
    raw, corrected = (
        make_training_images(scene, SCENE.cameras, PARTS.images["adaptive"], ImageSettings(flat_field=flat), "cpu")
        for scene, flat in ((SCENE, False), (given, True))
    )
    rates = GAIN * raw.images[:, 1].numpy()
    assert corrected.images[:, 1].numpy() == pytest.approx(
        np.maximum(rates - camera.dark, 0) / camera.gain / GAIN, abs=1e-5
    )


def counted(method: Any, scene: TrainingScene, budget: float) -> tuple[Any, int]:
    """Fit, and return the model and the steps that were taken."""
    steps: list[int] = []
    request = FitRequest(Budget(budget), progress=lambda done, total, note="": steps.append(total))
    return method.fit(scene, request), steps[-1]


def test_a_fit_follows_the_truth_that_it_was_handed_and_no_other_fit_does(root: Path, tmp_path: Path) -> None:
    """The truth handed in is twice as bright as what the spikes say: who is given it fits that."""
    lie = Truth.of(tmp_path, SCENE.id, SCENE.revision, SAMPLES)
    honest = Truth.of(root, SCENE.id, SCENE.revision, SAMPLES)
    for tick in TICKS:
        write(lie.image_file(tick), images=2 * honest.images([tick])[0])
    plain, few = counted(METHODS["spike4dgs-x"], SCENE, 0.04)
    bright, as_many = counted(OracleMethod("spike4dgs-x", ("images",), tmp_path, SAMPLES), SCENE, 0.04)
    longer, more = counted(OracleMethod("spike4dgs-x", ("gaussians", "steps"), tmp_path, SAMPLES), SCENE, 0.04)
    assert few == as_many and more == pytest.approx(4 * few, rel=0.02)
    middle = SCENE.duration_us / 2
    levels = [float(model.render(WORLD.held_out, middle).mean()) for model in (plain, bright, longer)]
    true = float(WORLD.trace(WORLD.held_out, 0.5)[0].mean())
    assert levels[0] == pytest.approx(true, rel=0.15) and levels[2] == pytest.approx(true, rel=0.15)
    assert levels[1] > 1.25 * levels[0]


def test_a_truth_of_another_revision_or_number_of_samples_is_not_taken(root: Path) -> None:
    for scene, samples in ((replace(SCENE, revision="another"), SAMPLES), (SCENE, 2 * SAMPLES)):
        with pytest.raises(UserError, match="expected true images, found no such file"):
            OracleMethod("spike4dgs-x", ("images",), root, samples).fit(scene, FitRequest(Budget(0.001)))


def test_oracles_are_no_installed_methods_and_say_what_they_are(root: Path) -> None:
    (ladder,) = oracle_ladders((), root, SAMPLES)
    plain, *oracles = [rung.method for rung in ladder.rungs]
    assert ladder.method == "spike4dgs-x" and plain is METHODS["spike4dgs-x"] and not hasattr(plain, "oracle")
    assert tuple(o.oracle for o in oracles) == RUNGS  # type: ignore[attr-defined]
    assert not {o.name for o in oracles} & set(find_methods())
    own = [{k: v for k, v in o.params["settings"].items() if v != plain.params["settings"][k]} for o in oracles]
    assert [set(changes) for changes in own] == [set(), set(), set(), set(), {"density"}, set(), {"density"}]
    assert [o.params["oracle"].get("steps") for o in oracles] == [None] * 5 + [4.0, 4.0]
    other = oracle_ladders((), root, 2 * SAMPLES)[0].rungs
    same = [a.method.params == b.method.params for a, b in zip(ladder.rungs, other, strict=True)]
    expected = [True, False, False, True, True, True, True, False]
    assert same == expected, "samples are part of what true images and points are"
    assert ladder.image_ticks(SCENE.n_ticks) == TICKS
    names = [o.name for o in oracles]
    assert [pickle.loads(pickle.dumps(o)).params for o in oracles] == [o.params for o in oracles]
    assert len(set(names)) == len(names)


def test_recipes_without_velocities_or_background_have_a_ladder_too(root: Path) -> None:
    (ladder,) = oracle_ladders(("tfp+4dgs",), root, SAMPLES)
    assert len(ladder.rungs) == len(RUNGS) and len(ladder.left_out) == 1
    settings = {rung.title: rung.method.params["settings"] for rung in ladder.rungs}
    assert settings["more Gaussians"]["density"]["max_per_pixel"] > 100
    assert settings["true calibration"]["images"]["flat_field"] and not settings["as it is"]["images"]["flat_field"]
    assert settings["true calibration"]["initialization"]["flat_field"]


@pytest.mark.parametrize("name", ["nearest-view", "dy-spikenerf", "tfp+d3dgs", "spike4dgs-x+colmap", "nothing"])
def test_what_is_no_recipe_of_the_trainer_with_given_poses_has_no_ladder(root: Path, name: str) -> None:
    with pytest.raises(UserError, match="--methods: expected one of .*spike4dgs-x"):
        oracle_ladders((name,), root, SAMPLES)


@pytest.mark.slow
def test_the_command_climbs_the_ladder_of_a_made_scene(tiny_data: Path, tmp_path: Path, capsys) -> None:
    scene, out = Path(shutil.copytree(tiny_data / "car-0-tiny", tmp_path / "car-0-tiny")), tmp_path / "out"
    # The background of the truth is rendered with as few samples as the rest: no image is looked at.
    edit_json(scene / "scene.json", lambda meta: meta["source"]["sampling"].update(background_spp=16))
    write_manifest(scene)
    options = ["--samples", "16", "--budget", "0.005", "--device", "cpu", "--out", str(out)]
    assert main(["report", "oracle-ladder", str(scene), *options, "--metrics", "psnr"]) == 0
    assert "where things move" in " ".join(capsys.readouterr().out.split()) and not (out / "leaderboard").exists()
    rows = list(csv.DictReader((out / "ladder.csv").read_text().splitlines()))
    assert len(rows) == len(RUNGS) + 1 and all(r["scene"] == "car-0-tiny" and float(r["psnr"]) > 5 for r in rows)
    (ladder,) = oracle_ladders((), out / "truth", 16)
    for rung in ladder.rungs:
        method = read_record(out / f"results/{rung.method.name}.json")["method"]
        assert method.get("oracle") == (list(rung.method.oracle) if isinstance(rung.method, OracleMethod) else None)
        if "oracle" in method:
            assert main(["submit", str(out / f"results/{method['name']}.json"), "--leaderboard", str(out / "b")]) == 2
    assert not (out / "b").exists()
    kept = {p: p.stat().st_mtime_ns for p in out.rglob("prediction.json")}
    assert main(["report", "oracle-ladder", str(scene), *options, "--metrics", "psnr"]) == 0
    assert {p: p.stat().st_mtime_ns for p in out.rglob("prediction.json")} == kept and len(kept) == len(rows)


def test_the_command_refuses_imported_scenes(small_scene: Path, tmp_path: Path, capsys) -> None:
    out = ["--device", "cpu", "--out", str(tmp_path / "out")]
    assert main(["report", "oracle-ladder", str(small_scene), *out]) == 2
    assert "expected a scene whose world is here, for oracles, found source 'test'" in capsys.readouterr().err
    assert not (tmp_path / "out/predictions").exists()
