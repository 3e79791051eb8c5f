"""Hard inputs of cameras, lenses, poses, clocks and image files."""

import math
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from hard_case import REFUSAL, HardCase

from spike4dgs.benchmark.metrics.pose_error import Sim3, align_cameras, angle_deg, pose_errors, umeyama
from spike4dgs.benchmark.scene.camera_state import Clock, local_ticks, local_window
from spike4dgs.benchmark.scene.cameras import Camera, check_rotation, look_at
from spike4dgs.benchmark.scene.images import (
    decode_srgb,
    encode_srgb,
    read_exr,
    read_geometry,
    write_exr,
    write_geometry,
)
from spike4dgs.benchmark.scene.lens import distort, fold_radius, undistort

_BARREL = (-0.3, 0.1, 1e-3, -2e-3, -0.02)
_FOLDS = (-0.2, 0.0, 0.0, 0.0, 0.0)


def _camera(lens: tuple[float, ...] = ()) -> Camera:
    at, up = np.array([0.3, -2.0, 1.0]), np.array([0.0, 0.0, 1.0])
    return replace(look_at("c", at, np.zeros(3), up, focal=90, width=80, height=50), distortion=lens)


@pytest.mark.hard_case(
    asked="project through barrel, pincushion and tangential lenses up to the image's corners",
    twin="OpenCV's projectPoints, float64",
    unit="px",
    tolerance=1e-9,
)
def test_camera_lens(hard_case: HardCase) -> None:
    for lens in (_BARREL, (0.4, 0.3, 0.0, 0.0, 0.1), (0.0, 0.0, 0.02, -0.03, 0.0)):
        camera = _camera(lens)
        uv = hard_case.rng().random((500, 2)) * (camera.width, camera.height)
        points = replace(camera, distortion=()).unproject(uv, np.full(500, 2.0))
        rotation = cv2.Rodrigues(camera.R)[0]
        expected = cv2.projectPoints(points, rotation, camera.t, camera.K, np.array(lens))[0][:, 0]
        hard_case.close(camera.project(points)[0], expected, f"lens {lens}")


@pytest.mark.hard_case(
    asked="invert a lens up to 0.1 % before its fold",
    twin="the points that were distorted",
    unit="normalised",
    tolerance=1e-8,
)
def test_camera_lens_inverse(hard_case: HardCase) -> None:
    direction = hard_case.rng().normal(size=(400, 2))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    xy = direction * fold_radius(_FOLDS) * np.linspace(0, 0.999, 400)[:, None]
    hard_case.close(undistort(distort(xy, _FOLDS), _FOLDS), xy)


@pytest.mark.hard_case(
    asked="points beyond the fold, and rays that no point has",
    twin="NaN: there is no image",
    unit="values that are not NaN",
)
def test_camera_lens_fold(hard_case: HardCase) -> None:
    fold = fold_radius(_FOLDS)
    radii = np.array([1.001, 1.5, 1e3, 1e200])[:, None] * fold * np.array([[0.6, 0.8]])
    largest = 2 / 3 * fold  # of the distorted radius r (1 + k1 r^2), at its fold
    found = np.concatenate([distort(radii, _FOLDS), undistort(1.01 * largest * np.array([[0.6, 0.8], [1, 0]]), _FOLDS)])
    hard_case.check((~np.isnan(found)).sum(), f"{np.isnan(found).sum()} of {found.size} values are NaN")


@pytest.mark.hard_case(
    asked="project and unproject points 1 mm to 1e6 m away, 1e6 m from the origin",
    twin="the points themselves",
    unit="relative",
    tolerance=1e-9,
)
def test_camera_far(hard_case: HardCase) -> None:
    near, rng = _camera(), hard_case.rng()
    away = 1e6 * np.array([0.6, -0.8, 0.1])
    for depth in (1e-3, 1.0, 1e6):
        for name, shift in (("origin", np.zeros(3)), ("1e6 m off", away)):
            camera = replace(near, t=near.t - near.R @ shift)
            uv = rng.random((50, 2)) * (80, 50)
            found, z = camera.project(camera.unproject(uv, np.full(50, depth)))
            # a coordinate of 1e6 m has a last bit of 1e-10 m
            share = max(1e-16 * float(np.abs(shift).max()) / depth, 1e-12) / 1e-12
            both = np.c_[found / 80, z / depth] / share, np.c_[uv / 80, np.ones(50)] / share
            hard_case.close(*both, f"{depth:g} m, {name}")


@pytest.mark.hard_case(
    asked="project points behind the camera and on its plane",
    twin="depths with their sign: z <= 0 is behind",
    unit="wrong signs",
)
def test_camera_behind(hard_case: HardCase) -> None:
    camera = _camera()
    depths = np.array([-1e9, -1.0, -1e-9, 0.0, 1e-9, 1.0])
    points = camera.center + depths[:, None] * camera.R[2] + 0.1 * camera.R[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        _, z = camera.project(points)
    wrong = (np.sign(np.where(np.abs(z) < 1e-12, 0, z)) != np.sign(depths)).sum()
    hard_case.check(wrong, f"depths {', '.join(f'{v:g}' for v in z)} m")


@pytest.mark.hard_case(asked="matrices with NaN, a reflection, a scale, one that is not orthogonal", **REFUSAL)
def test_camera_rotation(hard_case: HardCase) -> None:
    bad = {
        "NaN": np.full((3, 3), np.nan),
        "a reflection": np.diag([1.0, 1.0, -1.0]),
        "a scale": 1.01 * np.eye(3),
        "a shear": np.eye(3) + 1e-4 * np.eye(3)[::-1],
        "zeros": np.zeros((3, 3)),
    }
    hard_case.refused({name: partial(check_rotation, R, "pose") for name, R in bad.items()})


@pytest.mark.hard_case(
    asked="angles of 0, 1e-9, 90, 180 - 1e-6 and 180 degrees", twin="the angle itself", unit="degrees", tolerance=1e-9
)
def test_poses_angle(hard_case: HardCase) -> None:
    degrees = np.array([0.0, 1e-9, 1e-4, 90.0, 180 - 1e-6, 180.0])
    axis = hard_case.rng().normal(size=3)
    axis /= np.linalg.norm(axis)
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    a = np.radians(degrees)[:, None, None]
    rotations = np.eye(3) + np.sin(a) * cross + 2 * np.sin(a / 2) ** 2 * cross @ cross  # Rodrigues' formula
    hard_case.close(angle_deg(rotations), degrees)


@pytest.mark.hard_case(
    asked="cameras in a line, in a plane, two of them; scales 1e-6 to 1e6",
    twin="the similarity that was applied",
    unit="relative to the array",
    tolerance=1e-6,
)
def test_poses_similarity(hard_case: HardCase) -> None:
    rng = hard_case.rng()
    up, target = np.array([0.0, 0.0, 1.0]), np.array([0.1, 4.0, 0.2])
    line = [np.array([x, 0.0, 1.0]) for x in np.linspace(-0.5, 0.5, 5)]
    plane = [np.array([x, 0.0, z]) for x in (-0.3, 0.0, 0.3) for z in (0.8, 1.2)]
    for name, centers in (("line", line), ("plane", plane), ("two", line[:2])):
        true = [look_at("c", c, target, up, focal=90, width=80, height=50) for c in centers]
        for scale in (1e-6, 1.0, 1e6):
            R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            there = Sim3(scale, R * np.sign(np.linalg.det(R)), scale * rng.normal(size=3))
            errors = pose_errors([there.camera(c) for c in true], true)
            both = np.r_[errors.translation_m / errors.array_m, np.radians(errors.rotation_deg)]
            hard_case.close(both, np.zeros_like(both), f"{name}, scale {scale:g}")


@pytest.mark.hard_case(
    asked="points for which a reflection would fit better", twin="determinant +1", unit="off", tolerance=1e-12
)
def test_poses_reflection(hard_case: HardCase) -> None:
    points = hard_case.rng().normal(size=(20, 3)) * [1, 0.8, 0.3]
    hard_case.close(float(np.linalg.det(umeyama(points, points * [1, 1, -1]).R)), 1.0)


@pytest.mark.hard_case(asked="align coincident cameras, one camera, points on a line, two points", **REFUSAL)
def test_poses_degenerate(hard_case: HardCase) -> None:
    here = [_camera()] * 3
    line = np.outer(np.arange(5.0), [1, 2, 3])
    hard_case.refused(
        {
            "three cameras at one place": lambda: align_cameras(here, here),
            "one camera": lambda: align_cameras(here[:1], here[:1]),
            "three and two cameras": lambda: align_cameras(here, here[:2]),
            "points on a line": lambda: umeyama(line, line),
            "coincident points": lambda: umeyama(np.zeros((5, 3)), np.zeros((5, 3))),
            "two points": lambda: umeyama(np.eye(3)[:2], np.eye(3)[:2]),
            "points with NaN": lambda: umeyama(np.full((5, 3), np.nan), np.eye(5)[:, :3]),
            "a partner at infinity": lambda: umeyama(np.eye(5)[:, :3], np.full((5, 3), np.inf)),
        }
    )


@pytest.mark.hard_case(
    asked="clocks that are 1e6 ticks off or fast by a percent, at the clip's ends",
    twin="rounded float64, clamped to the clip",
    unit="ticks",
)
def test_clock_ends(hard_case: HardCase) -> None:
    n, wrong, asked = 1000, 0, [0, 1, 499, 998, 999]
    for clock in (Clock(0.0), Clock(0.5), Clock(-1e6), Clock(1e6), Clock(-3.49, 0.01), Clock(12.0, -0.01)):
        exact = [math.floor(clock.local(t) + 0.5) for t in asked]
        ticks, inside = local_ticks(clock, asked, n)
        wrong += sum(t != min(max(e, 0), n - 1) for t, e in zip(ticks, exact, strict=True))
        wrong += sum(i != (0 <= e < n) for i, e in zip(inside, exact, strict=True))
        a, b = local_window(clock, 960, 1000, n)
        wrong += not (0 <= a and b <= n and b - a == 40)
    hard_case.check(wrong, f"6 clocks, {len(asked)} ticks and a window each")


@pytest.mark.hard_case(
    asked="write and read radiance of 0, 6e-8, 1e-5, 1 and 65,504 as half floats",
    twin="numpy.float16",
    unit="of radiance",
)
def test_files_hdr(hard_case: HardCase) -> None:
    image = np.array([[0, 6e-8, 1e-5, 0.1], [1, 1.0005, 2049, 65_504]], np.float32)
    write_exr(hard_case.folder / "hdr.exr", image, 0.0)
    hard_case.close(read_exr(hard_case.folder / "hdr.exr"), image.astype(np.float16).astype(np.float64))


@pytest.mark.hard_case(
    asked="depth from 1e-30 to infinity, ids up to 2^32 - 1", twin="the arrays themselves", unit="", tolerance=0
)
def test_files_geometry(hard_case: HardCase) -> None:
    depth = np.array([[1e-30, 1.0, 3e38, np.inf]], np.float32)
    ids = np.array([[0, 1, 2**31, 2**32 - 1]], np.uint32)
    flow = hard_case.rng().normal(0, 1e6, (1, 4, 2)).astype(np.float32)
    path = hard_case.folder / "geometry.exr"
    write_geometry(path, depth, ids, flow, 0.0)
    found = read_geometry(path)
    wrong = sum(int(np.count_nonzero(a != b)) for a, b in ((found.depth, depth), (found.ids, ids), (found.flow, flow)))
    hard_case.check(wrong, "depth, ids and flow of 4 pixels")


@pytest.mark.hard_case(asked="write NaN, infinity, 1e5; depth that is NaN", **REFUSAL)
def test_files_refuse(hard_case: HardCase) -> None:
    path, one = hard_case.folder / "bad.exr", np.ones((4, 4), np.float32)
    nan_depth = np.where(np.eye(4) > 0, np.nan, one).astype(np.float32)
    bad = {f"radiance {value}": one * np.float32(value) for value in ("nan", "inf", "1e5")}
    calls = {name: partial(write_exr, path, image, 0.0) for name, image in bad.items()}
    ids, flow = one.astype(np.uint32), np.zeros((4, 4, 2), np.float32)
    calls["depth with NaN"] = partial(write_geometry, path, nan_depth, ids, flow, 0.0)
    hard_case.refused(calls)


@pytest.mark.hard_case(
    asked="encode NaN, infinity, negative values and every 8-bit level",
    twin="the sRGB formula; every level comes back",
    unit="levels",
)
def test_files_srgb(hard_case: HardCase) -> None:
    levels = np.arange(256, dtype=np.uint8)
    wrong = int(np.count_nonzero(encode_srgb(decode_srgb(levels)) != levels))
    odd = encode_srgb(np.array([np.nan, -np.inf, -1.0, -1e-30, np.inf, 7.0, 1e-30]))
    wrong += int(np.count_nonzero(odd != [0, 0, 0, 0, 255, 255, 0]))
    hard_case.check(wrong, f"NaN is {odd[0]}, infinity {odd[4]} of 255")
