"""Structure from motion by COLMAP: SIFT features of one image per view, their matches, poses and points.

Images are enlarged before features are found, and all pairs are matched. Everything runs in one thread, so that the
same seed gives the same matches. One global mapping (rotation averaging, global positioning, bundle adjustment) solves
for all views at once: an array is small beside its distance to the scene, and the pair that incremental mapping begins
with then easily ends in a wrong but locally best pose.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.lazy import kept_sigterm
from spike4dgs.benchmark.metrics.pose_error import align_cameras
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import encode_srgb, write_png
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.sensor_model import gathered
from spike4dgs.method.settings import Settings
from spike4dgs.method.starts.clip import white_rates
from spike4dgs.method.training_views.pinholes import undistorted

if TYPE_CHECKING:  # its import takes over the handling of SIGTERM: left to those who use it
    import pycolmap

_SEEDS = 2**31  # of COLMAP, whose seeds are C ints


@dataclass(frozen=True)
class FeatureSettings(Settings):
    """Numbers of features, matches and triangulation (prefix `initialization`)."""

    enlarge: int = 2  # of images 200 px wide; at their own size SIFT finds about 400 features a view, at twice it 2,700
    peak_threshold: float = 0.002  # of SIFT's contrast, a third of COLMAP's: gray images of dim scenes are soft
    pair_error_px: float = 2.0  # of a match in an enlarged image to its epipolar line
    min_angle_deg: float = 0.5  # between a point's rays: the array is narrow


FEATURES = FeatureSettings()
FOCAL_PRIOR = 1.2  # image widths, COLMAP's own


@dataclass(frozen=True)
class Features:
    """The folder in which COLMAP finds images and matches; `names` are the images', in the views' order."""

    folder: Path
    database: Path
    names: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Mapping:
    """The result of structure from motion, in the frame of the calibrated training cameras."""

    cameras: tuple[Camera, ...]  # those registered, in the scene's order
    points: NDArray[np.float64]  # [N, 3] m
    values: Float32  # [N] gray radiance

    def of_all(self, scene: TrainingScene, who: str) -> Mapping:
        """Return the same, if it has all training views of `scene`. Raises UserError."""
        count, wanted = len(self.cameras), len(scene.cameras)
        if count < wanted:
            fix = "use rig, or a scene with more static texture"
            raise problem(f"{who} on {scene.id}", f"all {wanted} views registered", f"{count} of {wanted}", fix)
        return self


NOTHING = Mapping((), np.zeros((0, 3)), np.zeros(0, np.float32))


@contextmanager
def find_features(
    cameras: Sequence[Camera], images: Float32, seed: int, settings: FeatureSettings, focal_prior: float | None = None
) -> Iterator[Features]:
    """Yield features and matches of images [C, H, W], linear radiance, while the context lasts; COLMAP is silent in it.

    Views have their calibrated intrinsics, or share a camera whose focal length is a guess, `focal_prior` image widths.
    """
    with kept_sigterm():  # all that follows works on what this yields
        import pycolmap

    with tempfile.TemporaryDirectory(prefix="spike4dgs-colmap-") as folder, _quiet():
        names = _write_images(Path(folder), cameras, images, settings.enlarge)
        database = Path(folder) / "database.db"
        seed %= _SEEDS
        pycolmap.set_random_seed(seed)
        _extract(database, Path(folder), cameras, names, settings, focal_prior)
        _match(database, seed, settings)
        yield Features(Path(folder), database, tuple(names))


def _write_images(folder: Path, cameras: Sequence[Camera], images: Float32, enlarge: int) -> list[str]:
    names = [f"{camera.id}.png" for camera in cameras]
    for name, image in zip(names, images, strict=True):
        larger = cv2.resize(encode_srgb(image), None, fx=enlarge, fy=enlarge, interpolation=cv2.INTER_CUBIC)
        write_png(folder / name, np.asarray(larger, np.uint8))
    return names


def _extract(
    database: Path,
    folder: Path,
    cameras: Sequence[Camera],
    names: Sequence[str],
    settings: FeatureSettings,
    focal_prior: float | None,
) -> None:
    """Write cameras and features into the database; views share one camera where their intrinsics are equal."""
    import pycolmap

    reader = pycolmap.ImageReaderOptions()
    camera, enlarge = cameras[0], settings.enlarge
    size = (camera.width * enlarge / 2, camera.height * enlarge / 2)
    intrinsics = [[float(x) * enlarge for x in (c.fx, c.fy, c.cx, c.cy)] for c in cameras]
    alike = focal_prior is not None or all(values == intrinsics[0] for values in intrinsics)
    if focal_prior is None:
        reader.camera_model = "PINHOLE"
        reader.camera_params = ",".join(map(repr, intrinsics[0]))
    else:
        reader.camera_model = "SIMPLE_PINHOLE"
        reader.camera_params = f"{focal_prior * camera.width * enlarge},{size[0]},{size[1]}"
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = 1
    extraction.sift.peak_threshold = settings.peak_threshold
    pycolmap.extract_features(
        database,
        folder,
        camera_mode=pycolmap.CameraMode.SINGLE if alike else pycolmap.CameraMode.PER_IMAGE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    if alike:
        return
    with pycolmap.Database.open(database) as written:
        own = dict(zip(names, intrinsics, strict=True))
        for image in written.read_all_images():
            view = written.read_camera(image.camera_id)
            view.params = own[image.name]
            written.update_camera(view)


def _match(database: Path, seed: int, settings: FeatureSettings) -> None:
    """Write the matches of all pairs into the database."""
    import pycolmap

    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.num_threads = 1
    verification.ransac.random_seed = seed
    verification.ransac.max_error = settings.pair_error_px
    pycolmap.match_exhaustive(
        database, matching_options=matching, verification_options=verification, device=pycolmap.Device.cpu
    )


def in_scene(
    model: pycolmap.Reconstruction, cameras: Sequence[Camera], names: Sequence[str], images: Float32, enlarge: int
) -> Mapping:
    """Return the model's views and points, moved by the similarity that fits its views to the calibrated ones.

    With fewer than two views nothing can be aligned: then it is `NOTHING`.
    """
    posed = {i.name: i for i in model.images.values() if i.has_pose}
    found = [k for k, name in enumerate(names) if name in posed]
    if len(found) < 2:
        return NOTHING
    intrinsics = {number: camera.calibration_matrix() / enlarge for number, camera in model.cameras.items()}
    views = [posed[names[k]] for k in found]
    estimated = [_camera(view, intrinsics[view.camera_id], cameras[k]) for view, k in zip(views, found, strict=True)]
    move = align_cameras(estimated, [cameras[k] for k in found])
    view = {posed[names[k]].image_id: k for k in found}
    points, values = [], []
    for point in model.points3D.values():
        points.append(point.xyz)
        seen = [(view[e.image_id], model.images[e.image_id].points2D[e.point2D_idx].xy) for e in point.track.elements]
        values.append(np.mean([_at(images[k], xy / enlarge) for k, xy in seen]))
    return Mapping(
        tuple(move.camera(c) for c in estimated),
        move(np.asarray(points, np.float64).reshape(-1, 3)),
        np.asarray(values, np.float32),
    )


def _camera(image: pycolmap.Image, K: NDArray[np.float64], like: Camera) -> Camera:
    """Return the view with COLMAP's pose, with the intrinsics K that it used."""
    pose = image.cam_from_world().matrix()
    return replace(like, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2], R=pose[:, :3], t=pose[:, 3])


def _at(image: Float32, xy: NDArray[np.float64]) -> float:
    u, v = np.clip(xy.astype(int), 0, [image.shape[1] - 1, image.shape[0] - 1])
    return float(image[v, u])


def clip_means(scene: TrainingScene) -> Float32:
    """Return the mean radiance of each training view over the clip (its first 65535 ticks) [C, H, W]."""
    ticks = min(scene.n_ticks, 65535)
    counts = [gathered(s.counts(0, ticks).astype(np.float32), s.dead_ticks / ticks) for s in scene.streams]
    means = np.asarray(np.stack(counts) / (ticks * white_rates(scene)).astype(np.float32), np.float32)
    return undistorted(scene, means)


def map_views(
    cameras: Sequence[Camera],
    images: Float32,
    seed: int,
    settings: FeatureSettings = FEATURES,
    focal_prior: float | None = None,
) -> Mapping:
    """Return the structure from motion on one image of each training view [C, H, W], linear radiance.

    Views have the intrinsics of their `cameras`; with `focal_prior`, in image widths, they are unknown and one focal
    length for all is estimated. The same seed gives the same poses: everything runs in one thread. Where fewer than
    two views are registered, nothing can be aligned and the mapping is empty.
    """
    with find_features(cameras, images, seed, settings, focal_prior) as found:
        import pycolmap

        options = _options(seed, settings.min_angle_deg, refine_focal=focal_prior is not None)
        models = pycolmap.global_mapping(found.database, found.folder, found.folder / "out", options)
        if not models:
            return NOTHING
        largest = max(models.values(), key=lambda m: m.num_reg_images())
        return in_scene(largest, cameras, found.names, images, settings.enlarge)


def _options(seed: int, min_angle_deg: float, *, refine_focal: bool) -> pycolmap.GlobalPipelineOptions:
    import pycolmap

    options, seed = pycolmap.GlobalPipelineOptions(), seed % _SEEDS
    options.num_threads, options.random_seed = 1, seed
    options.mapper.num_threads, options.mapper.random_seed = 1, seed
    options.mapper.min_tri_angle_deg = min_angle_deg
    options.mapper.retriangulation.min_angle = min_angle_deg
    options.mapper.bundle_adjustment.refine_focal_length = refine_focal
    options.mapper.bundle_adjustment.refine_extra_params = False
    return options


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep COLMAP's log off the terminal; what matters is raised or returned."""
    import pycolmap

    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
