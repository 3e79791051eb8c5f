"""Poses that begin where a network found them, and end where the features that views match put them.

The features of corrected means of the clip are more exact than what the matching network sees in one short window, but
alone they may not tell where to begin: an array is small beside its distance. Triangulation and bundle adjustment of
all matches start from the network's poses. A view may then have a wrong but locally best pose: therefore each pose is
solved again, by points that the others agree on, and everything is adjusted once more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.msdi.pose import LEAST_POINTS, solve_pose
from spike4dgs.method.starts.structure_from_motion import (
    NOTHING,
    Features,
    FeatureSettings,
    Mapping,
    find_features,
    in_scene,
)

if TYPE_CHECKING:
    import pycolmap

Pose = tuple[Float64, Float64]  # world to camera, R [3, 3] and t [3]


@dataclass(frozen=True)
class MatchSettings(FeatureSettings):
    """Numbers of poses by matches (prefix `initialization`)."""

    resect_px: float = 1.0  # of a triangulated point to its feature, at the sensor's own size
    rough_error_px: float = 16.0  # of an observation of a point, in enlarged pixels, while poses are rough
    rough_angle_deg: float = 4.0  # of its ray


DEFAULTS = MatchSettings()


@dataclass(frozen=True)
class Tolerance:
    """The reach of an observation of a point, in enlarged pixels and degrees of its ray."""

    error_px: float
    angle_deg: float


FINE = Tolerance(4.0, 2.0)  # COLMAP's own


@dataclass(frozen=True, eq=False)
class Seen:
    """Features of all views, at the sensor's own size, and which of them are the same."""

    ids: tuple[int, ...]  # the views' in the database
    pixels: tuple[Float64, ...]  # [N, 2] of each view
    same: dict[tuple[int, int], NDArray[np.int64]]  # [M, 2] of views (i, j), i < j: indices of features

    def partners(self, i: int, j: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return indices of the features that views i and j have in common, in i and in j."""
        both = self.same[min(i, j), max(i, j)].T
        return (both[0], both[1]) if i < j else (both[1], both[0])


def bundle(
    scene: TrainingScene, poses: Sequence[Pose | None], images: Float32, seed: int, settings: MatchSettings = DEFAULTS
) -> Mapping:
    """Return poses of the training cameras, whose intrinsics are taken as given, and the points that they match.

    poses: the first ones, in any frame and at any scale, None where unknown. images: [C, H, W] linear radiance. The
    same seed gives the same poses. A view without a pose is left out.
    """
    with find_features(scene.cameras, images, seed, settings) as found:
        seen = read_matches(found, settings.enlarge)
        rough = Tolerance(settings.rough_error_px, settings.rough_angle_deg)
        model = _adjust(found, seen, poses, rough, settings.min_angle_deg)
        if model is None:
            return NOTHING
        again = _poses_again(model, seen, [camera.K for camera in scene.cameras], seed, settings.resect_px)
        model = _adjust(found, seen, again, FINE, settings.min_angle_deg)
        return NOTHING if model is None else in_scene(model, scene.cameras, found.names, images, settings.enlarge)


def read_matches(found: Features, enlarge: int) -> Seen:
    """Return features and matches as the database has them."""
    import pycolmap

    with pycolmap.Database.open(found.database) as database:
        number = {image.name: image.image_id for image in database.read_all_images()}
        ids = tuple(number[name] for name in found.names)
        pixels = tuple(np.asarray(database.read_keypoints(i), np.float64)[:, :2] / enlarge for i in ids)
        same = {
            (i, j): np.asarray(database.read_two_view_geometry(ids[i], ids[j]).inlier_matches, np.int64).reshape(-1, 2)
            for i, j in combinations(range(len(ids)), 2)
        }
    return Seen(ids, pixels, same)


def _poses_again(
    model: pycolmap.Reconstruction, seen: Seen, intrinsics: Sequence[Float64], seed: int, reach_px: float
) -> list[Pose | None]:
    """Return each view's pose by the points of features that it has in common with the views of the model."""
    at = [_points_of(model, image, len(pixels)) for image, pixels in zip(seen.ids, seen.pixels, strict=True)]
    poses: list[Pose | None] = []
    for view in range(len(seen.ids)):
        points, pixels = [], []
        for other in (k for k in range(len(seen.ids)) if k != view):
            mine, theirs = seen.partners(view, other)
            points.append(at[other][theirs])
            pixels.append(seen.pixels[view][mine])
        poses.append(_solve(np.concatenate(points), np.concatenate(pixels), intrinsics[view], reach_px, seed))
    return poses


def _solve(points: Float64, pixels: Float64, K: Float64, reach_px: float, seed: int) -> Pose | None:
    known = np.isfinite(points).all(axis=1)
    if known.sum() < LEAST_POINTS:
        return None
    return solve_pose(points[known], pixels[known], K, seed, reach_px=reach_px)


def _points_of(model: pycolmap.Reconstruction, image: int, count: int) -> Float64:
    """Return the points [count, 3] of a view's features; NaN for those without one, and all NaN for a view left out."""
    points = np.full((count, 3), np.nan)
    if model.exists_image(image):
        for k, feature in enumerate(model.image(image).points2D):
            if feature.has_point3D():
                points[k] = model.point3D(feature.point3D_id).xyz
    return points


def _adjust(
    found: Features, seen: Seen, poses: Sequence[Pose | None], tolerance: Tolerance, min_angle_deg: float
) -> pycolmap.Reconstruction | None:
    """Return points triangulated from the views that have poses, then both adjusted; None for fewer than two views."""
    import pycolmap

    posed = [(i, n, p) for i, n, p in zip(seen.ids, found.names, poses, strict=True) if p is not None]
    if len(posed) < 2:
        return None
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(found.database) as database:
        for camera in database.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        camera_of = {image: database.read_image(image).camera_id for image, _, _ in posed}
    for image, name, (R, t) in posed:
        view = pycolmap.Image(image_id=image, camera_id=camera_of[image], name=name)
        model.add_image_with_trivial_frame(view, pycolmap.Rigid3d(pycolmap.Rotation3d(R), t))
    model = pycolmap.triangulate_points(
        model, found.database, found.folder, found.folder, options=_triangulation(tolerance, min_angle_deg)
    )
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY  # some matches are wrong
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image, _, _ in posed:
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    return model


def _triangulation(tolerance: Tolerance, min_angle_deg: float) -> pycolmap.IncrementalPipelineOptions:
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.mapper.filter_max_reproj_error = tolerance.error_px
    options.mapper.filter_min_tri_angle = options.triangulation.min_angle = min_angle_deg
    options.triangulation.ignore_two_view_tracks = False
    options.triangulation.create_max_angle_error = tolerance.angle_deg
    options.triangulation.continue_max_angle_error = tolerance.angle_deg
    options.triangulation.complete_max_reproj_error = tolerance.error_px
    options.triangulation.merge_max_reproj_error = tolerance.error_px
    return options
