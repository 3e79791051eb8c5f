"""What the second renderer is given: geometry, cameras and light, against other ways to find them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.rendering.mitsuba_scene import MitsubaScene
from spike4dgs.generators.rendering.mitsuba_variant import load_mitsuba
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import WORLDS
from spike4dgs.studies.second_renderer import export

T_S = 0.0113


@pytest.fixture(scope="module")
def bird():
    return WORLDS["bird"].build(0, 10, 0.02)


def blender_pixels(facts: dict, points: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return where a Blender camera sees points: -z ahead, y up, a sensor of width 1 that the shift moves."""
    local = (np.linalg.inv(facts["matrix"]) @ np.c_[points, np.ones(len(points))].T)[:3]
    lens = 0.5 / np.tan(facts["fov_x_rad"] / 2)
    x = lens * local[0] / -local[2] - facts["shift"][0]  # in widths of the image, from its middle
    y = lens * local[1] / -local[2] - facts["shift"][1]
    return np.stack([(x + 0.5) * width, height / 2 - y * width], 1)


def test_blenders_camera_sees_points_where_ours_does(bird):
    points = bird.moving_points(T_S)[::50]
    for camera in cameras(bird, 200, 125, (0, 4, 8)):
        camera = replace(camera, cx=camera.cx + 7.25, cy=camera.cy - 3.5)
        seen = blender_pixels(export.camera_facts(camera), points, 200, 125)
        assert np.abs(seen - camera.project(points)[0]).max() < 1e-9


def test_a_lens_is_refused(bird):
    camera = replace(cameras(bird, 64, 40, (4,))[0], distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(UserError, match="expected a pinhole"):
        export.camera_facts(camera)


def test_surfaces_are_at_their_places_at_that_time(bird):
    moving = [s.mesh.vertices for s in export.surfaces_at(bird, T_S) if not s.name.startswith("static ")]
    assert np.abs(np.concatenate(moving) - bird.moving_points(T_S)).max() < 1e-12


def test_normals_are_those_of_our_renderer(bird):
    scene = MitsubaScene(bird)
    scene.set_time(T_S)
    own = load_mitsuba().traverse(scene.full)
    compared = 0
    for name in ("wing", "tail"):
        surface = next(s for s in export.surfaces_at(bird, T_S) if s.name == name)
        theirs = np.array(own[f"moving_{name}.vertex_normals"]).reshape(-1, 3)
        used = np.linalg.norm(surface.normals, axis=1) > 0.5
        assert np.abs(surface.normals - theirs)[used].max() < 2e-3  # slivers, in float32
        compared += used.sum()
    assert compared > 100


def test_the_sky_is_our_renderers(bird):
    mi = load_mitsuba()
    sky = next(spec for spec in bird.emitters.values() if spec["type"] == "envmap")
    scene = MitsubaScene(bird)
    emitter = next(e for e in scene.empty.emitters() if e.is_environment() and "scale" in str(mi.traverse(e)))
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    closed = sky["scale"] * export.sky_radiance(sky["bitmap"], directions)
    for direction, expected in zip(directions, closed, strict=True):
        si = mi.SurfaceInteraction3f()
        si.wi = mi.Vector3f(*(-direction).tolist())
        assert np.ravel(np.array(emitter.eval(si))) == pytest.approx(expected, rel=2e-4)


def test_a_texel_of_the_exported_sky_is_where_blender_has_it():
    bitmap = np.random.default_rng(1).random((16, 32, 3)).astype(np.float32)
    fine = export.sky_map(bitmap, "as ours")
    height, width = fine.shape[:2]
    rng = np.random.default_rng(2)
    for row, column in zip(rng.integers(height, size=20), rng.integers(width, size=20), strict=True):
        # Blender: u = 1/2 - atan2(y, x) / 2 pi from the left, v = 1/2 + asin(z) / pi from below
        turn, rise = 2 * np.pi * (0.5 - (column + 0.5) / width), np.pi * (0.5 - (row + 0.5) / height)
        direction = [np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)]
        assert fine[row, column] == pytest.approx(export.sky_radiance(bitmap, np.array(direction)), abs=1e-5)
    coarse = export.sky_map(bitmap, "by texel centres")
    assert np.abs(coarse - fine).max() > 0.1, "where a texel is makes a difference"


def test_suns_and_lamps_shine_where_ours_do():
    car, turntable = (WORLDS[name].build(0, 10, 0.02) for name in ("car", "turntable"))
    (sun,) = export.light_facts(car.emitters, "as ours")[0]["suns"]
    assert np.array(sun["matrix"])[:3, 2] == pytest.approx(car.shadow_sources[0, :3]), "lamps shine along -z"
    assert np.linalg.det(sun["matrix"]) == pytest.approx(1)
    (lamp,) = export.light_facts(turntable.emitters, "as ours")[0]["lamps"]
    corners = np.array(lamp["corners"])
    assert np.array(sorted(corners.tolist())) == pytest.approx(
        np.array(sorted(turntable.shadow_sources[1:, :3].tolist()))
    )
    front = np.cross(corners[1] - corners[0], corners[2] - corners[1])
    assert front @ (np.array([0, 0, 0.1]) - corners.mean(0)) > 0, "the front is towards the table"
    with pytest.raises(UserError, match="light glow: expected a sky, a sun or a lamp, found point"):
        export.light_facts({"glow": {"type": "point"}}, "as ours")


def test_the_file_holds_every_surface_and_shot(bird, tmp_path):
    shots = [export.Shot(c, 3, Path(f"{c.id}.exr")) for c in cameras(bird, 64, 40, (4, 0))]
    export.write_scene(tmp_path / "scene.npz", bird, T_S, shots, 16)
    with np.load(tmp_path / "scene.npz") as file:
        facts = json.loads(str(file["facts"]))
        assert [shot["out"] for shot in facts["shots"]] == ["cam_04.exr", "cam_00.exr"]
        assert facts["bounces"] == 2 and facts["samples"] == 16
        named = {surface["name"]: surface for surface in facts["surfaces"]}
        assert len(named) == len(facts["surfaces"]) == len(list(export.surfaces_at(bird, T_S)))
        assert {name for name, s in named.items() if "weights" in s} == {
            s.name for s in export.surfaces_at(bird, T_S) if s.material.gloss is not None and not s.material.metal
        }
        for name, surface in named.items():
            assert file[f"{name}/faces"].max() < len(file[f"{name}/vertices"]) == len(file[f"{name}/uv"])
            assert file[surface["image"]].shape[2] == 3
            assert (f"{name}/normals" in file.files) == surface["smooth"]
