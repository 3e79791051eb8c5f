import dataclasses
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.cameras import (
    Camera,
    border,
    from_nerfstudio,
    look_at,
    mitsuba_sensor,
    mitsuba_to_world,
    to_nerfstudio,
)
from spike4dgs.benchmark.scene.writer import colmap_distortion, write_colmap
from spike4dgs.generators.rendering.mitsuba_variant import load_mitsuba


@st.composite
def cameras(draw: st.DrawFn, square: bool = False) -> Camera:
    """Any pose within 100 m, any size, focal lengths from wide to tele, principal points off the middle."""
    width, height = draw(st.integers(16, 800)), draw(st.integers(16, 800))
    fx = width * draw(st.floats(0.3, 5))
    fy = fx if square else fx * draw(st.floats(0.8, 1.25))
    cx, cy = width * draw(st.floats(0.3, 0.7)), height * draw(st.floats(0.3, 0.7))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    R = Rotation.random(rng=rng).as_matrix()
    return Camera("cam_00", width, height, fx, fy, cx, cy, R, rng.uniform(-100, 100, 3))


def seen_points(camera: Camera, n: int = 40) -> np.ndarray:
    """World points in front of the camera, all over its image and from 0.5 to 50 m away."""
    rng = np.random.default_rng(0)
    uv = rng.uniform((0, 0), (camera.width, camera.height), (n, 2))
    return camera.unproject(uv, rng.uniform(0.5, 50, n))


def worst_px(a: Camera, b: Camera, points: np.ndarray) -> float:
    return float(np.abs(a.project(points)[0] - b.project(points)[0]).max())


@given(cameras(), st.integers(1, 900), st.integers(1, 900))
def test_a_scaled_camera_sees_the_same_points(camera: Camera, width: int, height: int) -> None:
    bent = dataclasses.replace(camera, distortion=(0.01, 0.0, 0.001, 0.0, 0.0))
    small = bent.scaled(width, height)
    assert (small.id, small.width, small.height) == (camera.id, width, height)
    points = seen_points(camera)
    expected = bent.project(points)[0] * (width / camera.width, height / camera.height)
    np.testing.assert_allclose(small.project(points)[0], expected, rtol=1e-9, atol=1e-6)


@given(cameras())
def test_projection_is_the_textbook_product(camera: Camera) -> None:
    points = seen_points(camera)
    p = (camera.K @ (camera.w2c @ np.c_[points, np.ones(len(points))].T)[:3]).T
    uv, z = camera.project(points)
    assert np.allclose(uv, p[:, :2] / p[:, 2:], atol=1e-6) and np.allclose(z, p[:, 2])
    assert np.allclose(camera.w2c @ camera.c2w, np.eye(4), atol=1e-9)
    assert np.allclose(camera.unproject(uv, z), points, atol=1e-6)


@given(cameras())
def test_nerfstudio_poses_mean_opengl_axes(camera: Camera) -> None:
    """Project with the OpenGL formula of nerfstudio itself: +y up, looking along -z."""
    frame = to_nerfstudio(camera)
    points = seen_points(camera)
    local = (np.linalg.inv(frame["transform_matrix"]) @ np.c_[points, np.ones(len(points))].T)[:3].T
    u = frame["cx"] + frame["fl_x"] * local[:, 0] / -local[:, 2]
    v = frame["cy"] - frame["fl_y"] * local[:, 1] / -local[:, 2]
    assert np.abs(np.stack([u, v], 1) - camera.project(points)[0]).max() < 0.01


@given(cameras(square=True))
def test_mitsuba_poses_mean_its_axes(camera: Camera) -> None:
    """Project as Mitsuba's manual says: x left, y up, z forward, fov along x, offsets relative to the film's size."""
    sensor, points = mitsuba_sensor(camera), seen_points(camera)
    local = (np.linalg.inv(mitsuba_to_world(camera)) @ np.c_[points, np.ones(len(points))].T)[:3].T
    half = np.tan(np.radians(sensor["fov"]) / 2)  # of the width, at distance 1
    u = (0.5 - local[:, 0] / local[:, 2] / (2 * half) - sensor["principal_point_offset_x"]) * camera.width
    v = 0.5 - sensor["principal_point_offset_y"] - local[:, 1] / local[:, 2] / (2 * half) * camera.width / camera.height
    assert np.abs(np.stack([u, v * camera.height], 1) - camera.project(points)[0]).max() < 0.01


@pytest.fixture
def scalar_mitsuba() -> Iterator[ModuleType]:
    """Mitsuba, one ray at a time; tests that follow in this process get the variant that they had."""
    mi = load_mitsuba()
    before = mi.variant()
    mi.set_variant("scalar_rgb")
    yield mi
    mi.set_variant(before)


@pytest.mark.parametrize("seed", range(3))
def test_a_ray_of_mitsubas_sensor_hits_our_pixel(scalar_mitsuba: ModuleType, seed: int) -> None:
    mi = scalar_mitsuba
    rng = np.random.default_rng(seed)
    width, height = 64, 40
    origin, target, up = rng.uniform(-3, 3, 3) + [0, -8, 0], rng.uniform(-1, 1, 3), np.array([0.0, 0, 1])
    camera = look_at("c", origin, target, up, focal=70.0, width=width, height=height)
    camera = dataclasses.replace(camera, cx=width * 0.45, cy=height * 0.56)
    film = {"type": "hdrfilm", "width": width, "height": height}
    to_world = mi.ScalarTransform4f(mitsuba_to_world(camera))
    sensor = mi.load_dict({"type": "perspective", "to_world": to_world, "film": film, **mitsuba_sensor(camera)})
    for uv in rng.uniform(0.02, 0.98, (20, 2)):
        ray, _ = sensor.sample_ray(0, 0.5, mi.Point2f(uv), mi.Point2f(0.5))
        point = np.array(ray.o) + 5.0 * np.array(ray.d)
        found, z = camera.project(point[None])
        assert z[0] > 0
        assert np.abs(found[0] - uv * (width, height)).max() < 0.01


@settings(max_examples=15, deadline=None)
@given(camera=cameras())
def test_pycolmap_projects_our_points_to_our_pixels(tmp_path_factory: pytest.TempPathFactory, camera: Camera) -> None:
    folder = tmp_path_factory.mktemp("sparse")
    both = [camera, dataclasses.replace(camera, id="cam_01", t=camera.t + 1)]
    write_colmap(folder, both, np.zeros((1, 3)))
    images = {image.name: image for image in pycolmap.Reconstruction(str(folder)).images.values()}
    for one in both:
        for point in seen_points(one, 10):
            assert np.abs(images[one.id].project_point(point) - one.project(point[None])[0][0]).max() < 0.01


@pytest.mark.parametrize("origin", [(0, -5, 2), (3, 0.1, 4), (-2, 6, -1)])
def test_look_at_puts_the_target_in_the_middle_and_up_on_top(origin: tuple[float, ...]) -> None:
    target, up = np.array([0.2, 0.3, 0.4]), np.array([0.0, 0, 1])
    camera = look_at("c", np.array(origin, dtype=float), target, up, focal=100.0, width=80, height=50)
    uv, z = camera.project(np.stack([target, target + 0.1 * up]))
    assert np.allclose(uv[0], (40, 25)) and z[0] == pytest.approx(np.linalg.norm(target - origin))
    assert uv[1, 1] < uv[0, 1] and uv[1, 0] == pytest.approx(40, abs=1e-6)
    assert np.allclose(camera.center, origin) and np.linalg.det(camera.R) == pytest.approx(1)


GOOD: dict[str, Any] = {
    "fl_x": 1.0, "fl_y": 1.0, "cx": 1.0, "cy": 1.0, "w": 2, "h": 2, "transform_matrix": np.eye(4).tolist(),
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fl_x": None}, "expected fl_x"),
        ({"w": "wide"}, "expected fl_x"),
        ({"transform_matrix": [[1, 2], [3, 4]]}, "expected fl_x, fl_y, cx, cy, w, h and a 4x4 transform_matrix"),
        ({"transform_matrix": np.eye(3).tolist()}, "4x4 transform_matrix"),
        ({"transform_matrix": (2 * np.eye(4)).tolist()}, "expected a rotation matrix"),
        ({"transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}, "determinant -1"),
        ({"transform_matrix": np.full((4, 4), np.nan).tolist()}, "nan is no number"),
    ],
)
def test_poses_that_are_none_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError) as e:
        from_nerfstudio("cam_07", {**GOOD, **change}, "transforms_train.json")
    assert "cam_07" in str(e.value) and message in str(e.value) and "\n" not in str(e.value)
    with pytest.raises(UserError, match="KeyError"):
        from_nerfstudio("cam_07", {k: v for k, v in GOOD.items() if k not in change})


def test_mitsuba_cannot_model_oblong_pixels() -> None:
    camera = look_at("c", np.array([0.0, -1, 0]), np.zeros(3), np.array([0.0, 0, 1]), focal=9.0, width=4, height=4)
    with pytest.raises(UserError, match="fx = fy"):
        mitsuba_sensor(dataclasses.replace(camera, fy=10.0))


def with_lens(camera: Camera, *lens: float) -> Camera:
    """The camera with a lens that bends as much at its corners as it would at radius 1/2."""
    corner = max(np.hypot(x, y) for x, y in camera.normalized(border(camera)))
    scales = [(0.5 / corner) ** power for power in (2, 4, 1, 1, 6)]
    return dataclasses.replace(camera, distortion=tuple(k * s for k, s in zip(lens, scales, strict=True)))


@settings(max_examples=40, deadline=None)
@given(cameras(), st.floats(-0.4, 0.4), st.floats(-0.1, 0.1), st.booleans())
def test_a_lens_is_opencvs_and_goes_through_all_files(pinhole: Camera, k1: float, k2: float, cubic: bool) -> None:
    camera = with_lens(pinhole, k1, k2, 1e-3, -2e-3, 0.02 * cubic)
    points = seen_points(camera)
    uv, z = camera.project(points)
    K = camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV's pixel centres are at whole numbers
    rotation = cv2.Rodrigues(camera.R)[0]
    expected = cv2.projectPoints(points, rotation, camera.t, K, np.array(camera.distortion))[0].reshape(-1, 2) + 0.5
    assert np.abs(uv - expected).max() < 1e-4  # Rodrigues' vectors near half a turn are this exact
    assert np.allclose(camera.unproject(uv, z), points, atol=1e-5)
    assert worst_px(camera, from_nerfstudio("cam_00", to_nerfstudio(camera)), points) < 1e-6


def small_camera() -> Camera:
    forward, up = np.array([0, 1.0, 0]), np.array([0, 0, 1.0])
    return look_at("cam_00", np.zeros(3), forward, up, focal=50, width=40, height=30)


def test_a_pinhole_has_no_keys_of_a_lens() -> None:
    pinhole = small_camera()
    assert not {"k1", "k2", "p1", "p2", "k3"} & set(to_nerfstudio(pinhole))
    frame = {**to_nerfstudio(pinhole), "k1": -0.1, "k2": 0.0}
    assert from_nerfstudio("cam_00", frame).distortion == (-0.1, 0.0, 0.0, 0.0, 0.0)
    with pytest.raises(UserError, match="cam_00 whose model holds up to the image's corners, found k1 -5"):
        from_nerfstudio("cam_00", {**frame, "k1": -5.0})
    with pytest.raises(UserError, match="a pinhole for Mitsuba's sensor, found lens distortion"):
        mitsuba_sensor(from_nerfstudio("cam_00", frame))


@pytest.mark.parametrize("lens", [(-0.2, 0.03, 1e-3, -1e-3, 0.0), (-0.2, 0.03, 0.0, 0.0, 0.01)])
def test_colmap_projects_through_the_lens(tmp_path: Path, lens: tuple[float, ...]) -> None:
    camera = dataclasses.replace(small_camera(), distortion=lens)
    write_colmap(tmp_path, [camera], np.zeros((0, 3)))
    model = pycolmap.Reconstruction(str(tmp_path))
    assert model.camera(1).model.name == ("FULL_OPENCV" if lens[4] else "OPENCV")
    points = seen_points(camera)
    expected = np.array([model.image(1).project_point(p) for p in points])
    assert np.abs(camera.project(points)[0] - expected).max() < 1e-6
    assert colmap_distortion(model.camera(1)) == pytest.approx(lens)
