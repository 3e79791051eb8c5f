"""The truth that oracles are given, against what the scene folder itself says: its truth, geometry, maps and facts."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from changes import edit_json
from toy_fits import silent

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import write_json
from spike4dgs.benchmark.scene.images import read_geometry
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.benchmark.untrusted import read_npz
from spike4dgs.generators.physics import Physics
from spike4dgs.generators.profiles import PROFILES, SPLIT_PROFILES, Job
from spike4dgs.generators.render_tasks import cameras_of, recorded_job, renderer_of
from spike4dgs.generators.rendering.split_render import SplitRenderer
from spike4dgs.studies.oracle_truth import Truth, WorldTruth, find_truth

TICKS, SAMPLES = (10, 70), 16
MIDDLE = 40  # of 80 ticks: a target of the held-out camera


@pytest.fixture(scope="module")
def scene(tiny_data: Path) -> Scene:
    return open_scene(tiny_data / "car-0-tiny")


def found_truth(scene: Scene) -> WorldTruth:
    """The truth of the scene, its background with an eighth of the samples: no test of the written truth needs more."""
    job = find_truth(scene).job
    profile = replace(job.profile, background_spp=job.profile.background_spp // 8)
    return WorldTruth(replace(job, profile=profile), find_truth(scene).cameras)


@pytest.fixture(scope="session")  # it outlives tests of other files that a worker takes from another
def truth(tiny_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Truth:
    scene = open_scene(tiny_data / "car-0-tiny")
    made = Truth.of(tmp_path_factory.mktemp("truth"), scene.id, scene.revision, SAMPLES)
    found_truth(scene).write(made, TICKS, SAMPLES, silent)
    return made


def test_a_scene_records_the_job_that_made_it() -> None:
    physics = Physics(lens=(-0.1, 0.0, 0.0, 0.0, 0.0), lens_spread=0.3, flicker=0.08, dead_ticks=1)
    for job in (
        Job("car", 0, 0, "tiny", PROFILES["tiny"], 0.004),
        Job("van", 3, 2**70, "small", PROFILES["small"], 0.5, False, False, False, False, False, True, physics, 2),
    ):
        assert recorded_job(json.loads(json.dumps(job.settings)), Path()) == job
    assert recorded_job({"kind": "mitsuba", "world": "nowhere"}, Path()) is None


def rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a.astype(np.float64) - b) ** 2)))


def test_images_at_the_held_out_camera_are_its_truth_but_for_noise(scene: Scene) -> None:
    """The function that renders an oracle's images is asked for the one view of which the scene has the truth."""
    found = find_truth(scene)
    renderer = found.renderer([scene.cameras["cam_04"]], found.job.profile.target_spp)
    targets = {tick: scene.ground_truth(Target("cam_04", tick)) for tick in (20, MIDDLE, 60)}
    image = renderer.keys(MIDDLE / scene.rate_hz)[0]
    # Every pixel traced with the truth's own number of samples is noisier than a background that has more.
    noise = rms(renderer.crn_frames(MIDDLE / scene.rate_hz)[0], targets[MIDDLE])
    assert 0 < rms(image, targets[MIDDLE]) < 1.1 * noise, "other random numbers than the truth's, and nothing else"
    assert abs(float(np.mean(image - targets[MIDDLE]))) < 0.002
    moving = scene.moving(Target("cam_04", MIDDLE))
    there = {tick: rms(image[moving], target[moving]) for tick, target in targets.items()}
    assert min(there[20], there[60]) > 2 * there[MIDDLE], "it is that tick's alone"


def test_split_light_is_rendered_as_the_scene_was() -> None:
    """Its truth has maps of soft light, and so has that of oracles: whole paths would differ by what maps smooth."""
    job = Job("car", 0, 0, "tiny", SPLIT_PROFILES["tiny"], 0.004)
    scene_truth = renderer_of(job, cameras_of(job)[:1], truth=True)
    oracle = WorldTruth(job, cameras_of(job)).renderer(cameras_of(job)[:1], 16)
    assert isinstance(scene_truth, SplitRenderer) and isinstance(oracle, SplitRenderer)
    assert oracle.soft == scene_truth.soft and oracle._anchor_s == scene_truth._anchor_s
    assert oracle._seed != scene_truth._seed and not oracle.color


def test_images_are_those_of_the_training_cameras_in_their_order(scene: Scene, truth: Truth) -> None:
    images = truth.images(TICKS)
    size = scene.cameras["cam_00"].height, scene.cameras["cam_00"].width
    assert images.shape == (2, len(scene.train), *size) and images.dtype == np.float32
    assert "cam_04" not in scene.train
    streams = [scene.stream(c) for c in scene.train]
    rates = [s.counts(0, s.n_ticks) / s.n_ticks / scene.radiance_gain for s in streams]
    means = images.mean(axis=0)
    own = [rms(mean, rate) for mean, rate in zip(means, rates, strict=True)]
    others = [rms(mean, rate) for mean, rate in zip(means, np.roll(rates, 1, axis=0), strict=True)]
    assert max(own) < 0.5 * min(others), "each is like its own camera's mean rate and unlike the next one's"


def in_view(scene: Scene, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which points the held-out camera has in its image, their pixels (v, u) and their depths."""
    camera = scene.cameras["cam_04"]
    uv, z = camera.project(points.astype(np.float64))
    inside = (z > 0) & (uv >= 0).all(1) & (uv < [camera.width, camera.height]).all(1)
    u, v = uv[inside].astype(int).T
    return inside, np.stack([v, u]), z[inside]


def test_points_lie_on_surfaces_that_another_camera_sees(scene: Scene, truth: Truth) -> None:
    surfaces = truth.surfaces()
    geometry = read_geometry(scene.manifest.path(f"geometry/cam_04/{MIDDLE:06d}.exr"))
    inside, (v, u), z = in_view(scene, surfaces.points)
    assert inside.mean() > 0.5
    around = np.stack(
        [geometry.depth[np.clip(v + i, 0, 39), np.clip(u + j, 0, 63)] for i in (-1, 0, 1) for j in (-1, 0, 1)]
    )
    assert (z < 0.99 * around.min(0)).mean() < 0.005, "nothing floats in front of what the camera sees"
    assert ((z > 0.99 * around.min(0)) & (z < 1.01 * around.max(0))).mean() > 0.8, "most of it is seen, the rest hidden"
    moving = np.linalg.norm(surfaces.velocities, axis=1)[inside] > 0
    ids = geometry.ids[v, u]
    seen = np.isclose(z, geometry.depth[v, u], rtol=0.005)
    assert (ids[seen & moving] > 0).mean() > 0.9 and (ids[seen & ~moving] == 0).mean() > 0.97


def test_velocities_are_those_of_a_car_and_of_its_rolling_wheels(scene: Scene, truth: Truth) -> None:
    surfaces, speed = truth.surfaces(), scene.meta["source"]["notes"]["speed_m_s"]
    moving = surfaces.velocities[np.linalg.norm(surfaces.velocities, axis=1) > 0]
    assert 50 < len(moving) < 0.5 * len(surfaces.points)
    body = np.isclose(moving, [speed, 0, 0], atol=1e-3 * speed).all(axis=1)
    assert body.mean() > 0.6
    # A point of a wheel that rolls without slipping goes round the hub, no faster than the car beside the hub.
    wheels = moving[~body] - [speed, 0, 0]
    assert len(wheels) and (np.linalg.norm(wheels, axis=1) < 1.01 * speed).all()
    assert np.abs(wheels[:, 1]).max() < 1e-3 * speed, "within the wheel's plane"


def test_values_are_the_radiance_that_other_views_see_there(scene: Scene, truth: Truth) -> None:
    surfaces, image = truth.surfaces(), scene.ground_truth(Target("cam_04", MIDDLE))
    geometry = read_geometry(scene.manifest.path(f"geometry/cam_04/{MIDDLE:06d}.exr"))
    inside, (v, u), z = in_view(scene, surfaces.points)
    seen = np.isclose(z, geometry.depth[v, u], rtol=0.005)
    error = np.abs(surfaces.values[inside] - image[v, u])[seen]
    shuffled = np.abs(surfaces.values[inside] - np.roll(image[v, u], 97))[seen]
    assert np.median(error) < 0.25 * np.median(shuffled)


def test_maps_are_those_in_the_scenes_own_truth(scene: Scene, truth: Truth) -> None:
    calibrations = truth.calibrations(scene.radiance_gain)
    for camera, found in zip(scene.train, calibrations, strict=True):
        maps = read_npz(scene.manifest.path(f"truth/{camera}.npz"), "maps")
        assert np.array_equal(found.gain, maps["gain"]) and np.array_equal(found.dark, maps["dark"])
        assert found.radiance_gain == scene.radiance_gain


def everything(truth: Truth) -> dict[Path, tuple[int, bytes]]:
    return {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in truth.folder.rglob("*.npz")}


def test_what_is_there_is_kept_and_what_is_missing_is_made_again_alike(scene: Scene, truth: Truth, tmp_path) -> None:
    copy = Truth(Path(shutil.copytree(truth.folder, tmp_path / truth.folder.name)))
    before = everything(copy)
    copy.image_file(TICKS[1]).unlink()
    found_truth(scene).write(copy, TICKS, SAMPLES, silent)
    after = everything(copy)
    assert {p: content for p, (_, content) in after.items()} == {p: content for p, (_, content) in before.items()}
    rewritten = {p.name for p in after if after[p][0] != before[p][0]}
    assert rewritten <= {copy.image_file(TICKS[1]).name, copy.sensors_file.name}


def test_scenes_that_no_world_here_made_are_refused(small_scene: Path) -> None:
    with pytest.raises(UserError, match="expected a scene whose world is here"):
        find_truth(open_scene(small_scene))


@pytest.mark.parametrize("physics", [{"flicker": 0.08}, {"array_motion": 2.0}])
def test_scenes_whose_light_or_array_changes_are_refused(
    tiny_data: Path, tmp_path: Path, physics: dict[str, float]
) -> None:
    scene = Path(shutil.copytree(tiny_data / "car-0-tiny", tmp_path / "copy"))
    edit_json(scene / "scene.json", lambda meta: meta["source"].update(physics=physics))
    write_manifest(scene)
    with pytest.raises(UserError, match="expected an array at rest in steady light"):
        find_truth(open_scene(scene))


def test_scenes_with_other_cameras_than_their_worlds_are_refused(tiny_data: Path, tmp_path: Path) -> None:
    moved = Path(shutil.copytree(tiny_data / "car-0-tiny", tmp_path / "moved"))
    for name in ("train", "all"):
        file = moved / f"transforms_{name}.json"
        if file.is_file():
            transforms = json.loads(file.read_text())
            transforms["frames"][0]["transform_matrix"][0][3] += 0.01
            write_json(file, transforms)
    write_manifest(moved)
    with pytest.raises(UserError, match="expected the cameras of its world"):
        find_truth(open_scene(moved))


@pytest.mark.parametrize("samples", [0, 100])
def test_samples_are_a_power_of_two(scene: Scene, tmp_path: Path, samples: int) -> None:
    with pytest.raises(UserError, match="--samples: expected a power of two"):
        find_truth(scene).write(Truth(tmp_path), TICKS, samples, silent)
