"""Each deviation from ideal cameras and light against a closed form or a published figure, through `make-dataset`.

Also the names and settings of the scenes to make.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_renderer import car, render_fakes

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.cameras import from_nerfstudio
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.stream import open_stream
from spike4dgs.generators.physics import CAMERAS, Physics, PhysicsOptions, from_settings, given_cameras, true_cameras
from spike4dgs.generators.profiles import PROFILES, Job
from spike4dgs.generators.render_tasks import cameras_of, recorded_job, world_of
from spike4dgs.generators.scene_maker import Maker
from spike4dgs.generators.streams import extras, sensor_of

JOB = Job("car", 0, 0, "tiny", PROFILES["tiny"], PROFILES["tiny"].seconds)
PLAIN = replace(JOB, world="blank")  # takes no time to build
ROOT = Path(JOB.id)


def job(**physics):
    return replace(JOB, physics=Physics(**physics))


def plain(stage, steps, total):
    yield from steps


@pytest.fixture
def made(tmp_path, monkeypatch):
    """Make a scene with some deviations; return its folder."""
    render_fakes(monkeypatch)
    return lambda of: Maker(of, tmp_path, plain).make()


@pytest.fixture(scope="module")
def ideal(tmp_path_factory) -> Path:
    """The scene with every deviation off; no test may change it."""
    with pytest.MonkeyPatch.context() as patch:
        render_fakes(patch)
        return Maker(JOB, tmp_path_factory.mktemp("ideal"), plain).make()


def test_what_is_off_is_neither_in_the_id_nor_in_the_settings():
    assert JOB.id == "car-0-tiny" and "physics" not in JOB.settings
    assert job(psf_px=0.5, dead_ticks=1).id == "car-0-tiny-psf-dead"
    assert [job(light=x).id for x in (1 / 16, 2)] == ["car-0-tiny-light1of16", "car-0-tiny-light2"]
    assert job(speed=1.5, flicker=0.1).id == "car-0-tiny-flicker-speed3of2"
    assert replace(JOB, physics=CAMERAS["realistic"]).id == "car-0-tiny-realistic"
    assert PhysicsOptions().physics() == CAMERAS["ideal"] == Physics()
    curved = job(lens=(-0.1, 0.0, 0.0, 0.0, 0.0))
    assert curved.id == "car-0-tiny-lens"
    assert curved.settings == JOB.settings | {"physics": {"lens": [-0.1, 0.0, 0.0, 0.0, 0.0]}}


def test_names_contain_a_length_that_is_not_the_profiles():
    assert Job("car", 2, 0, "paper", PROFILES["paper"], 0.5).id == "car-2-paper-500ms"
    assert Job("car", 2, 0, "paper", PROFILES["paper"], 0.1).id == "car-2-paper"
    assert list(Job("car", 0, 0, "small", PROFILES["small"], 0.02).target_ticks) == list(range(20, 400, 20))


def test_seeds_beyond_64_bits_are_text_in_the_settings():
    """Readers of JSON other than Python's keep 64 bits of an integer at most."""
    seeds = (0, 2**63 - 1, 2**63, 2**128 - 1)
    found = [replace(JOB, seed=seed).settings["seed"] for seed in seeds]
    assert found == [0, 2**63 - 1, str(2**63), str(2**128 - 1)]


def test_settings_are_read_back():
    for physics in (Physics(), CAMERAS["realistic"], Physics(flicker=0.3, pose_noise_deg=0.1, dead_ticks=2)):
        assert from_settings(json.loads(json.dumps(physics.settings))) == physics
        made = replace(JOB, physics=physics)
        assert recorded_job(json.loads(json.dumps(made.settings)), ROOT) == made


SAMPLING = JOB.settings["sampling"]


@pytest.mark.parametrize(
    "change",
    [
        {"seed": None},
        {"seed": -1},
        {"variant": "x"},
        {"variant": True},
        {"seconds": "x"},
        {"sampling": {}},
        {"sampling": SAMPLING | {"width": "w"}},
        {"sampling": SAMPLING | {"views": ["v"]}},
        {"sampling": SAMPLING | {"soft": {"paths": "p", "gloss_paths": 1, "sigma_px": 1, "anchor_px": 1, "spread": 1}}},
        {"physics": []},
        {"physics": {"glare": 1}},
        {"physics": {"light": "bright"}},
    ],
)
def test_settings_that_are_no_worlds_are_one_error_that_names_the_scene(change):
    with pytest.raises(UserError, match="^car-0-tiny/scene.json, source: expected the settings of car"):
        recorded_job(json.loads(json.dumps(JOB.settings)) | change, ROOT)
    for source in ({"kind": "mitsuba"}, {"kind": "mitsuba", "world": ["car"]}):
        assert recorded_job(source, ROOT) is None


def test_an_option_replaces_that_of_the_named_camera():
    realistic = CAMERAS["realistic"]
    assert PhysicsOptions("realistic").physics() == realistic
    assert PhysicsOptions("realistic", psf_px=0.0).physics() == replace(realistic, psf_px=0.0)
    straight = PhysicsOptions("realistic", lens=(0.0,)).physics()
    assert straight == replace(realistic, lens=(), lens_spread=0.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"camera": "best"}, "--camera: expected one of ideal, realistic"),
        ({"psf_px": 2.0}, "--psf-px: expected px from 0 to 0.8"),
        ({"flicker": 1.5}, "--flicker: expected a depth"),
        ({"flicker": float("nan")}, "--flicker"),
        ({"flicker": 0.1, "flicker_duty": 1.0}, "--flicker-duty: expected 0"),
        ({"flicker": 0.1, "flicker_hz": 0.0}, "--flicker-hz: expected Hz from 1"),
        ({"pose_noise_deg": -1.0}, "--pose-noise-deg"),
        ({"dead_ticks": -1}, "--dead-ticks"),
        ({"dead_ticks": 11}, "--dead-ticks: expected ticks from 0 to 10"),
        ({"read_noise": 1.0}, "--read-noise"),
        ({"light": 0.0}, "--light: expected a share from 1/1024 to 16"),
        ({"lost_ticks": 1.0}, "--lost-ticks"),
        ({"speed": 0.0}, "--speed"),
        ({"array_motion": -1.0}, "--array-motion: expected metres per second"),
        ({"array_rotation": 1e4}, "--array-rotation: expected degrees per second"),
    ],
)
def test_numbers_that_no_camera_has_are_one_line(options, words):
    with pytest.raises(UserError, match=words) as e:
        PhysicsOptions(**options).physics()
    assert "\n" not in str(e.value)


def test_lenses_that_differ_are_weaker_or_stronger_copies_of_the_mean_one():
    nine = replace(PLAIN, profile_name="small", profile=PROFILES["small"])
    lens = (-0.1, 0.03, 0.0, 0.0, 0.0)
    alike, different = (replace(nine, physics=Physics(lens=lens, lens_spread=s)) for s in (0.0, 0.3))
    assert {c.distortion for c in cameras_of(alike)} == {lens}
    shares = np.array([np.array(c.distortion[:2]) / lens[:2] - 1 for c in cameras_of(different)])
    assert np.abs(shares).max() <= 0.3 and len(set(shares[:, 0])) == 9
    assert shares[:, 0] == pytest.approx(shares[:, 1])
    again, other = cameras_of(replace(different)), cameras_of(replace(different, seed=1))
    assert [c.distortion for c in again] == [c.distortion for c in cameras_of(different)]
    assert all(a.distortion != b.distortion for a, b in zip(again, other, strict=True))
    assert not any(c.distortion for c in cameras_of(nine))


def test_principal_points_spread_by_the_stated_share_of_the_width():
    rig, views = cameras_of(PLAIN), PLAIN.profile.views
    found = []
    for seed in range(200):
        for c, ideal in zip(true_cameras(rig, views, Physics(principal_point=0.02), seed), rig, strict=True):
            found.append([c.cx - ideal.cx, c.cy - ideal.cy])
            assert (c.fx, c.fy) == (ideal.fx, ideal.fy) and np.array_equal(c.t, ideal.t)
    assert np.std(found, axis=0) == pytest.approx(0.02 * 64, rel=0.1)


def test_given_poses_move_pixels_by_what_their_noise_says():
    """A turn by s radians about x or y moves the middle of the image by s f px, a shift by s metres by s f / z."""
    rig, z = cameras_of(PLAIN), 12.0
    moved = {"pose_noise_deg": [], "pose_noise_m": []}
    sizes = {"pose_noise_deg": np.degrees(1e-3), "pose_noise_m": 1e-3 * z}
    for name, found in moved.items():
        for seed in range(300):
            given = given_cameras(rig, "cam_04", Physics(**{name: sizes[name]}), [seed])
            for true, other in zip(rig, given, strict=True):
                middle = true.unproject(np.array([[true.cx, true.cy]]), np.array([z]))
                shift = (other.project(middle)[0] - true.project(middle)[0])[0] / true.fx
                if true.id == "cam_04":
                    assert other is true  # the question of the default split
                else:
                    found.append(shift)
        assert np.std(found, axis=0) == pytest.approx(1e-3, rel=0.1)
        assert np.allclose(other.R @ other.R.T, np.eye(3))


def test_a_scene_of_moved_poses_keeps_the_true_ones_where_no_method_looks(made):
    moved = job(pose_noise_deg=0.05, pose_noise_m=0.002)
    scene = open_scene(made(moved))
    truth = json.loads((scene.root / "truth/cameras.json").read_text())
    for camera in cameras_of(moved):
        known = from_nerfstudio(camera.id, truth[camera.id])
        assert np.allclose(known.R, camera.R) and np.allclose(known.t, camera.t)
        given = scene.cameras[camera.id]
        assert np.allclose(given.R, camera.R, atol=1e-9) == (camera.id == "cam_04")
    assert scene.meta["source"]["physics"] == {"pose_noise_deg": 0.05, "pose_noise_m": 0.002}


def test_dark_current_doubles_every_8_kelvin_between_silicons_two_laws():
    """Arrhenius: it follows exp(-E / kT) with all of the band gap of 1.12 eV (diffusion) or half of it (generation)."""
    for gap, sign in ((1.12, 1), (0.56, -1)):
        law = np.exp(gap / 8.617e-5 * (1 / 300 - 1 / 308))
        assert (law - Physics(warming_k=8.0).dark_factor) * sign > 0
    assert Physics(warming_k=8.0).dark_factor == 2 and Physics(warming_k=-16.0).dark_factor == 0.25


def test_a_warm_sensor_doubles_its_dark_rate_in_the_clip_and_not_in_the_calibration(ideal, made):
    folders = [ideal, made(job(warming_k=8.0))]
    for name in ("calibration/dark/cam_00.dat", "calibration/flat/cam_00.dat"):
        assert len({(f / name).read_bytes() for f in folders}) == 1
    counts = [open_stream(f / "spikes/cam_00.dat", 64, 40, 2e4, rows_bottom_up=True).counts(0, 80) for f in folders]
    added = np.mean(counts[1].astype(int) - counts[0]) / 80
    assert added == pytest.approx(sensor_of(JOB, cameras_of(JOB)[0]).dark.mean(), rel=0.1)


def test_a_scene_states_the_light_of_its_flat_recording():
    for light, radiance in ((0.25, 0.7), (2, 0.7), (4, 0.35)):
        assert extras(job(light=light))["calibration"]["flat_radiance"] == pytest.approx(radiance)


def test_a_stopped_down_lens_scales_light_and_neither_the_dark_rate_nor_the_truth(ideal, made):
    full, dim = (open_scene(folder) for folder in (ideal, made(job(light=0.25))))
    assert dim.radiance_gain == full.radiance_gain / 4
    for name in (f"images/{full.targets[0].name}.exr", "calibration/dark/cam_00.dat"):
        assert (full.root / name).read_bytes() == (dim.root / name).read_bytes()
    dark = sensor_of(JOB, cameras_of(JOB)[0]).dark
    clips = [s.stream("cam_00").counts(0, 80) / 80 for s in (full, dim)]
    flats = [s.recordings("cam_00").flat.counts(0, 500) / 500 for s in (full, dim)]
    for of_full, of_dim in (clips, flats):
        assert (of_dim - dark).mean() == pytest.approx((of_full - dark).mean() / 4, rel=0.02)


@pytest.mark.parametrize("name", ["blank", "bird"])  # rigid, and deforming
def test_twice_the_speed_is_the_same_motion_in_half_the_time(name):
    job = replace(JOB, world=name)
    fast = world_of(replace(job, physics=Physics(speed=2)))
    slow = world_of(replace(job, seconds=2 * job.seconds))  # the same motion
    for t_s in (0.0, 0.0011, job.seconds):
        assert np.array_equal(fast.moving_points(t_s), slow.moving_points(2 * t_s))
    assert fast.duration_s == job.seconds and fast.object_names == slow.object_names


def test_an_array_that_moves_is_recorded_beside_the_scene_and_changes_no_camera(ideal, made):
    moving = job(array_motion=2.0, array_rotation=30.0)
    scene = made(moving)
    assert scene.name == "car-0-tiny-arraymotion-arrayrotation"
    assert recorded_job(json.loads((scene / "scene.json").read_text())["source"], scene) == moving
    assert (scene / "transforms_all.json").read_bytes() == (ideal / "transforms_all.json").read_bytes()
    told = json.loads((scene / "truth/array_path.json").read_text())
    assert told["ticks"] == [0, 20, 40, 60, 80] and not (ideal / "truth/array_path.json").exists()
    first, last = (np.array(told["array_to_world"][k]) for k in (0, -1))
    np.testing.assert_array_equal(first, np.eye(4))
    middle = np.array(car().rig.center)
    assert np.linalg.norm(last[:3, :3] @ middle + last[:3, 3] - middle) == pytest.approx(2.0 * 0.004, rel=1e-3)


def test_lost_ticks_are_zeros_that_the_scene_lists(ideal, made):
    holed = made(job(lost_ticks=0.2))
    with pytest.raises(UserError, match="--allow-gaps"):
        open_scene(holed)
    whole, holed = open_scene(ideal), open_scene(holed, allow_gaps=True)
    lost = []
    for camera in whole.cameras:
        there = present([g for g in holed.gaps if g.camera == camera], 80)
        packed = [s.stream(camera).packed for s in (whole, holed)]
        assert np.array_equal(packed[0][there], packed[1][there]) and not packed[1][~there].any()
        lost.append(~there)
    assert np.mean(lost) == pytest.approx(0.2, abs=0.08) and not np.array_equal(lost[0], lost[1])


def test_flicker_is_in_the_streams_and_in_the_truth_at_its_instant(ideal, made):
    flickering = job(flicker=0.5, flicker_hz=250)
    steady, lit = (open_scene(folder) for folder in (ideal, made(flickering)))
    light = flickering.flicker
    for target in steady.targets:
        ratio = lit.ground_truth(target) / steady.ground_truth(target)
        assert ratio == pytest.approx(light.at(target.tick), rel=2e-3)
        assert np.array_equal(lit.moving(target), steady.moving(target))
    counts = [s.stream("cam_00").counts(20, 40).astype(float).sum() for s in (steady, lit)]
    dark = sensor_of(JOB, cameras_of(JOB)[0]).dark.sum() * 20
    expected = np.mean([light.mean(t) for t in range(20, 40)])
    assert (counts[1] - dark) / (counts[0] - dark) == pytest.approx(expected, rel=0.01)


def test_a_scenes_description_states_what_the_sensor_does(ideal, made):
    real = job(dead_ticks=1, read_noise=0.006, reset_noise=0.0009, clock_ripple=0.008)
    scene = open_scene(made(real))
    sensor, training = scene.meta["sensor"], scene.training
    assert (sensor["dead_ticks"], sensor["read_noise"], sensor["reset_noise"]) == (1, 0.006, 0.0009)
    assert sensor["clock_ripple"] == sensor_of(real, cameras_of(real)[0]).clock_ripple == 0.008
    known = [*training.streams, *(x for r in training.recordings for x in (r.flat, r.dark))]
    assert {x.dead_ticks for x in known} == {1.0}, "methods know the law"
    assert not {"dead_ticks", "psf_px"} & set(open_scene(ideal).meta["sensor"])


def test_noise_of_other_sensors_changes_nothing_else(ideal, made):
    quiet, noisy = (open_scene(folder) for folder in (ideal, made(job(noisy_others=True))))
    assert noisy.id == "car-0-tiny-others" and noisy.revision == quiet.revision
    assert noisy.meta["source"]["physics"] == {"noisy_others": True}
    assert noisy.meta["conventional"]["noise"] == {"full_well": 10_700.0, "read": 2.9}
    assert noisy.meta["events"]["noise"]["shot_hz"] == 5.0 and "noise" not in quiet.meta["events"]
    assert len(noisy.events("cam_00")) != len(quiet.events("cam_00"))
