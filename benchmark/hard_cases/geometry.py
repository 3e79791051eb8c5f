"""Hard cases of cameras, lenses, poses, clocks and image files."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from spike4dgs.benchmark.hard_cases.case import Case, Outcome, Setting, compare, refused, worst
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

_REFUSAL = "the contract: one clear error each"
_BARREL = (-0.3, 0.1, 1e-3, -2e-3, -0.02)
_FOLDS = (-0.2, 0.0, 0.0, 0.0, 0.0)


def cases() -> list[Case]:
    """Return the cases of cameras and files."""
    return [
        _case("camera/lens", "project through barrel, pincushion and tangential lenses up to the image's corners",
              "OpenCV's projectPoints, float64", "px", 1e-9, _lens),
        _case("camera/lens-inverse", "invert a lens up to 0.1 % before its fold",
              "the points that were distorted", "normalised", 1e-8, _lens_inverse),
        _case("camera/lens-fold", "points beyond the fold, and rays that no point has",
              "NaN: there is no image", "values that are not NaN", 0, _beyond_fold),
        _case("camera/far", "project and unproject points 1 mm to 1e6 m away, 1e6 m from the origin",
              "the points themselves", "relative", 1e-9, _far),
        _case("camera/behind", "project points behind the camera and on its plane",
              "depths with their sign: z <= 0 is behind", "wrong signs", 0, _behind),
        _case("camera/rotation", "matrices with NaN, a reflection, a scale, one that is not orthogonal", _REFUSAL,
              "inputs taken", 0, _rotations),
        _case("poses/angle", "angles of 0, 1e-9, 90, 180 - 1e-6 and 180 degrees", "the angle itself", "degrees", 1e-9,
              _angles),
        _case("poses/similarity", "cameras in a line, in a plane, two of them; scales 1e-6 to 1e6",
              "the similarity that was applied", "relative to the array", 1e-6, _similarities),
        _case("poses/reflection", "points for which a reflection would fit better", "determinant +1", "off",
              1e-12, _reflection),
        _case("poses/degenerate", "align coincident cameras, one camera, points on a line, two points", _REFUSAL,
              "inputs taken", 0, _degenerate),
        _case("clock/ends", "clocks that are 1e6 ticks off or fast by a percent, at the clip's ends",
              "rounded float64, clamped to the clip", "ticks", 0, _clocks),
        _case("files/hdr", "write and read radiance of 0, 6e-8, 1e-5, 1 and 65,504 as half floats",
              "numpy.float16", "of radiance", 0, _half_floats),
        _case("files/geometry", "depth from 1e-30 to infinity, ids up to 2^32 - 1", "the arrays themselves", "", 0,
              _geometry),
        _case("files/refuse", "write NaN, infinity, 1e5; depth that is NaN", _REFUSAL,
              "inputs taken", 0, _bad_files),
        _case("files/srgb", "encode NaN, infinity, negative values and every 8-bit level",
              "the sRGB formula; every level comes back", "levels", 0, _srgb),
    ]  # fmt: skip


def _case(name: str, asked: str, twin: str, unit: str, tolerance: float, run: Callable[[Setting], Outcome]) -> Case:
    return Case(id=f"benchmark/{name}", asked=asked, twin=twin, unit=unit, tolerance=tolerance, run=run)


def _camera(lens: tuple[float, ...] = ()) -> Camera:
    camera = look_at(
        "c", np.array([0.3, -2.0, 1.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]), focal=90, width=80, height=50
    )
    return replace(camera, distortion=lens)


def _lens(setting: Setting) -> Outcome:
    import cv2

    outcomes = {}
    for lens in (_BARREL, (0.4, 0.3, 0.0, 0.0, 0.1), (0.0, 0.0, 0.02, -0.03, 0.0)):
        camera = _camera(lens)
        uv = setting.rng().random((500, 2)) * (camera.width, camera.height)
        points = replace(camera, distortion=()).unproject(uv, np.full(500, 2.0))
        rotation = cv2.Rodrigues(camera.R)[0]
        expected = cv2.projectPoints(points, rotation, camera.t, camera.K, np.array(lens))[0][:, 0]
        outcomes[f"lens {lens}"] = compare(camera.project(points)[0], expected)
    return worst(outcomes)


def _lens_inverse(setting: Setting) -> Outcome:
    direction = setting.rng().normal(size=(400, 2))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    xy = direction * fold_radius(_FOLDS) * np.linspace(0, 0.999, 400)[:, None]
    return compare(undistort(distort(xy, _FOLDS), _FOLDS), xy)


def _beyond_fold(setting: Setting) -> Outcome:
    fold = fold_radius(_FOLDS)
    radii = np.array([1.001, 1.5, 1e3, 1e200])[:, None] * fold * np.array([[0.6, 0.8]])
    largest = 2 / 3 * fold  # of the distorted radius r (1 + k1 r^2), at its fold
    found = np.concatenate([distort(radii, _FOLDS), undistort(1.01 * largest * np.array([[0.6, 0.8], [1, 0]]), _FOLDS)])
    return Outcome(f"{np.isnan(found).sum()} of {found.size} values are NaN", float((~np.isnan(found)).sum()))


def _far(setting: Setting) -> Outcome:
    near, rng = _camera(), setting.rng()
    away = 1e6 * np.array([0.6, -0.8, 0.1])
    outcomes = {}
    for depth in (1e-3, 1.0, 1e6):
        for name, shift in (("origin", np.zeros(3)), ("1e6 m off", away)):
            camera = replace(near, t=near.t - near.R @ shift)
            uv = rng.random((50, 2)) * (80, 50)
            found, z = camera.project(camera.unproject(uv, np.full(50, depth)))
            # a coordinate of 1e6 m has a last bit of 1e-10 m
            share = max(1e-16 * float(np.abs(shift).max()) / depth, 1e-12) / 1e-12
            outcomes[f"{depth:g} m, {name}"] = compare(
                np.c_[found / 80, z / depth] / share, np.c_[uv / 80, np.ones(50)] / share
            )
    return worst(outcomes)


def _behind(setting: Setting) -> Outcome:
    camera = _camera()
    depths = np.array([-1e9, -1.0, -1e-9, 0.0, 1e-9, 1.0])
    points = camera.center + depths[:, None] * camera.R[2] + 0.1 * camera.R[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        _, z = camera.project(points)
    wrong = (np.sign(np.where(np.abs(z) < 1e-12, 0, z)) != np.sign(depths)).sum()
    return Outcome(f"depths {', '.join(f'{v:g}' for v in z)} m", float(wrong))


def _rotations(setting: Setting) -> Outcome:
    bad = {
        "NaN": np.full((3, 3), np.nan),
        "a reflection": np.diag([1.0, 1.0, -1.0]),
        "a scale": 1.01 * np.eye(3),
        "a shear": np.eye(3) + 1e-4 * np.eye(3)[::-1],
        "zeros": np.zeros((3, 3)),
    }
    return refused({name: partial(check_rotation, R, "pose") for name, R in bad.items()})


def _angles(setting: Setting) -> Outcome:
    degrees = np.array([0.0, 1e-9, 1e-4, 90.0, 180 - 1e-6, 180.0])
    axis = setting.rng().normal(size=3)
    axis /= np.linalg.norm(axis)
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    a = np.radians(degrees)[:, None, None]
    rotations = np.eye(3) + np.sin(a) * cross + 2 * np.sin(a / 2) ** 2 * cross @ cross  # Rodrigues' formula
    return compare(angle_deg(rotations), degrees)


def _similarities(setting: Setting) -> Outcome:
    rng, outcomes = setting.rng(), {}
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
            outcomes[f"{name}, scale {scale:g}"] = compare(both, np.zeros_like(both))
    return worst(outcomes)


def _reflection(setting: Setting) -> Outcome:
    points = setting.rng().normal(size=(20, 3)) * [1, 0.8, 0.3]
    return compare(float(np.linalg.det(umeyama(points, points * [1, 1, -1]).R)), 1.0)


def _degenerate(setting: Setting) -> Outcome:
    here = [_camera()] * 3
    line = np.outer(np.arange(5.0), [1, 2, 3])
    return refused(
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


def _clocks(setting: Setting) -> Outcome:
    n, wrong, asked = 1000, 0, [0, 1, 499, 998, 999]
    for clock in (Clock(0.0), Clock(0.5), Clock(-1e6), Clock(1e6), Clock(-3.49, 0.01), Clock(12.0, -0.01)):
        exact = [math.floor(clock.local(t) + 0.5) for t in asked]
        ticks, inside = local_ticks(clock, asked, n)
        wrong += sum(t != min(max(e, 0), n - 1) for t, e in zip(ticks, exact, strict=True))
        wrong += sum(i != (0 <= e < n) for i, e in zip(inside, exact, strict=True))
        a, b = local_window(clock, 960, 1000, n)
        wrong += not (0 <= a and b <= n and b - a == 40)
    return Outcome(f"6 clocks, {len(asked)} ticks and a window each", float(wrong))


def _half_floats(setting: Setting) -> Outcome:
    image = np.array([[0, 6e-8, 1e-5, 0.1], [1, 1.0005, 2049, 65_504]], np.float32)
    write_exr(setting.folder / "hdr.exr", image, 0.0)
    return compare(read_exr(setting.folder / "hdr.exr"), image.astype(np.float16).astype(np.float64))


def _geometry(setting: Setting) -> Outcome:
    depth = np.array([[1e-30, 1.0, 3e38, np.inf]], np.float32)
    ids = np.array([[0, 1, 2**31, 2**32 - 1]], np.uint32)
    flow = setting.rng().normal(0, 1e6, (1, 4, 2)).astype(np.float32)
    path = setting.folder / "geometry.exr"
    write_geometry(path, depth, ids, flow, 0.0)
    found = read_geometry(path)
    wrong = sum(int(np.count_nonzero(a != b)) for a, b in ((found.depth, depth), (found.ids, ids), (found.flow, flow)))
    return Outcome("depth, ids and flow of 4 pixels", float(wrong))


def _bad_files(setting: Setting) -> Outcome:
    path, one = setting.folder / "bad.exr", np.ones((4, 4), np.float32)
    nan_depth = np.where(np.eye(4) > 0, np.nan, one).astype(np.float32)
    calls: dict[str, Callable[[], object]] = {
        f"radiance {value}": lambda value=value: write_exr(path, one * np.float32(value), 0.0)  # type: ignore[misc]
        for value in ("nan", "inf", "1e5")
    }
    calls["depth with NaN"] = lambda: write_geometry(
        path, nan_depth, one.astype(np.uint32), np.zeros((4, 4, 2), np.float32), 0
    )
    return refused(calls)


def _srgb(setting: Setting) -> Outcome:
    levels = np.arange(256, dtype=np.uint8)
    wrong = int(np.count_nonzero(encode_srgb(decode_srgb(levels)) != levels))
    odd = encode_srgb(np.array([np.nan, -np.inf, -1.0, -1e-30, np.inf, 7.0, 1e-30]))
    wrong += int(np.count_nonzero(odd != [0, 0, 0, 0, 255, 255, 0]))
    return Outcome(f"NaN is {odd[0]}, infinity {odd[4]} of 255", float(wrong))
