"""The initialisations `colmap`, `colmap-flat` and `colmap-uncalibrated`: poses by structure from motion (COLMAP).

SIFT features of one picture per training view, the mean of the whole clip: what moves is a blur there, and the static
rest, where the spikes' quantisation noise has averaged out, carries the poses of a rig that stands still. Pictures are
enlarged before the features are found, all pairs are matched, and one global mapping (rotation averaging, global
positioning, bundle adjustment) solves for all views at once: an array is small beside its distance to the scene, and
the pair that incremental mapping begins with is then easily placed in a wrong but locally best way.

`colmap` keeps the calibrated intrinsics; `colmap-uncalibrated` knows nothing and refines one focal length for all
views from a prior of 1.2 image widths. Their points are COLMAP's. `colmap-flat` finds features in pictures corrected by
the cameras' calibrations, of which there are nearly twice as many, and sweeps planes from the poses, as `rig-flat` does
from given ones. Poses come out in a frame of their own: the similarity that fits them to the
calibrated training poses (`benchmark.poses`) takes everything to the scene's frame, where held-out cameras are known.
Calibrated poses serve for nothing else.
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

from spike4dgs.baselines.rig import rig, rig_flat, window_means
from spike4dgs.benchmark.cameras import Camera
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.images import encode_srgb, write_png
from spike4dgs.benchmark.poses import align_cameras
from spike4dgs.benchmark.scene import TrainingScene
from spike4dgs.method.fit import Start

if TYPE_CHECKING:  # its import takes over the handling of SIGTERM: left to those who use it
    import pycolmap

Float32 = NDArray[np.float32]

ENLARGE = 2  # of pictures 200 px wide; at their own size SIFT finds about 400 features a view, at twice it 2,700
PEAK_THRESHOLD = 0.002  # of SIFT's contrast, a third of COLMAP's: gray pictures of dim scenes are soft
PAIR_ERROR_PX = 2.0  # of a match in an enlarged picture to its epipolar line
MIN_ANGLE_DEG = 0.5  # between a point's rays: the array is narrow
FOCAL_PRIOR = 1.2  # image widths, COLMAP's own
MIN_POINTS = 100  # fewer are no start for Gaussians: they come from a plane sweep with the estimated cameras


@dataclass(frozen=True, eq=False)
class Mapping:
    """What structure from motion found, in the frame of the calibrated training cameras."""

    cameras: tuple[Camera, ...]  # those registered, in the scene's order
    points: NDArray[np.float64]  # [N, 3] m
    values: Float32  # [N] gray radiance


def colmap(scene: TrainingScene, seed: int) -> Start:
    """Poses and points with the calibrated intrinsics; see the module.

    Raises UserError unless all training views are registered.
    """
    return _start(scene, map_views(scene, clip_means(scene), seed, calibrated=True), seed)


def colmap_uncalibrated(scene: TrainingScene, seed: int) -> Start:
    """The same, with intrinsics unknown."""
    return _start(scene, map_views(scene, clip_means(scene), seed, calibrated=False), seed)


def colmap_flat(scene: TrainingScene, seed: int) -> Start:
    """Poses from corrected pictures with the calibrated intrinsics, and points by plane sweep from there."""
    pictures = window_means(scene, 0, scene.n_ticks, flat_field=True)
    found = _whole(scene, map_views(scene, pictures, seed, calibrated=True))
    return rig_flat(replace(scene, cameras=found.cameras), seed)


def _start(scene: TrainingScene, found: Mapping, seed: int) -> Start:
    if len(_whole(scene, found).points) < MIN_POINTS:
        return rig(replace(scene, cameras=found.cameras), seed)
    return Start(found.cameras, found.points.astype(np.float32), found.values)


def _whole(scene: TrainingScene, found: Mapping) -> Mapping:
    """`found`, if it has all views. Raises UserError."""
    count, wanted = len(found.cameras), len(scene.cameras)
    if count < wanted:
        fix = "use rig, or a scene with more static texture"
        raise problem(f"COLMAP on {scene.id}", f"all {wanted} views registered", f"{count} of {wanted}", fix)
    return found


def clip_means(scene: TrainingScene) -> Float32:
    """The mean radiance of each training view over the clip (its first 65535 ticks) [C, H, W]."""
    ticks = min(scene.n_ticks, 65535)
    counts = np.stack([s.counts(0, ticks) for s in scene.streams]).astype(np.float32)
    return counts / np.float32(ticks * scene.radiance_gain)


def map_views(scene: TrainingScene, pictures: Float32, seed: int, *, calibrated: bool) -> Mapping:
    """Structure from motion on one picture of each training view [C, H, W], linear radiance.

    The same seed gives the same poses: everything runs in one thread. Where fewer than two views are registered,
    nothing can be aligned and the mapping is empty.
    """
    import pycolmap

    with tempfile.TemporaryDirectory(prefix="spike4dgs-colmap-") as folder, _quiet():
        names = _write_pictures(Path(folder), scene.cameras, pictures)
        database = Path(folder) / "database.db"
        pycolmap.set_random_seed(seed)
        _match(database, Path(folder), scene.cameras[0], seed, calibrated)
        found = pycolmap.global_mapping(database, Path(folder), Path(folder) / "out", _options(seed, calibrated))
    models = list(found.values())
    if not models:
        return Mapping((), np.zeros((0, 3)), np.zeros(0, np.float32))
    return _in_scene(max(models, key=lambda m: m.num_reg_images()), scene.cameras, names, pictures)


def _write_pictures(folder: Path, cameras: Sequence[Camera], pictures: Float32) -> list[str]:
    names = [f"{camera.id}.png" for camera in cameras]
    for name, picture in zip(names, pictures, strict=True):
        image = cv2.resize(encode_srgb(picture), None, fx=ENLARGE, fy=ENLARGE, interpolation=cv2.INTER_CUBIC)
        write_png(folder / name, np.asarray(image, np.uint8))
    return names


def _match(database: Path, folder: Path, camera: Camera, seed: int, calibrated: bool) -> None:
    """Features and matches of all pairs into the database; all views share one camera."""
    import pycolmap

    reader = pycolmap.ImageReaderOptions()
    size = (camera.width * ENLARGE / 2, camera.height * ENLARGE / 2)
    if calibrated:
        reader.camera_model = "PINHOLE"
        intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy]
        reader.camera_params = ",".join(repr(float(x) * ENLARGE) for x in intrinsics)
    else:
        reader.camera_model = "SIMPLE_PINHOLE"
        reader.camera_params = f"{FOCAL_PRIOR * camera.width * ENLARGE},{size[0]},{size[1]}"
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = 1
    extraction.sift.peak_threshold = PEAK_THRESHOLD
    cpu = pycolmap.Device.cpu
    pycolmap.extract_features(
        database,
        folder,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=cpu,
    )
    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.num_threads = 1
    verification.ransac.random_seed = seed
    verification.ransac.max_error = PAIR_ERROR_PX
    pycolmap.match_exhaustive(database, matching_options=matching, verification_options=verification, device=cpu)


def _options(seed: int, calibrated: bool) -> pycolmap.GlobalPipelineOptions:
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = 1, seed
    options.mapper.num_threads, options.mapper.random_seed = 1, seed
    options.mapper.min_tri_angle_deg = MIN_ANGLE_DEG
    options.mapper.retriangulation.min_angle = MIN_ANGLE_DEG
    options.mapper.bundle_adjustment.refine_focal_length = not calibrated
    options.mapper.bundle_adjustment.refine_extra_params = False
    return options


def _in_scene(
    model: pycolmap.Reconstruction, cameras: Sequence[Camera], names: Sequence[str], pictures: Float32
) -> Mapping:
    """The model's views and points, moved by the similarity that fits its views to the calibrated ones."""
    images = {i.name: i for i in model.images.values() if i.has_pose}
    camera = next(iter(model.cameras.values()))  # all views share it
    places = [k for k, name in enumerate(names) if name in images]
    if len(places) < 2:
        return Mapping((), np.zeros((0, 3)), np.zeros(0, np.float32))
    K = camera.calibration_matrix() / ENLARGE
    estimated = [_camera(images[names[k]], K, cameras[k]) for k in places]
    move = align_cameras(estimated, [cameras[k] for k in places])
    view = {images[names[k]].image_id: k for k in places}
    points, values = [], []
    for point in model.points3D.values():
        points.append(point.xyz)
        seen = [(view[e.image_id], model.images[e.image_id].points2D[e.point2D_idx].xy) for e in point.track.elements]
        values.append(np.mean([_at(pictures[k], xy / ENLARGE) for k, xy in seen]))
    return Mapping(
        tuple(move.camera(c) for c in estimated),
        move(np.asarray(points, np.float64).reshape(-1, 3)),
        np.asarray(values, np.float32),
    )


def _camera(image: pycolmap.Image, K: NDArray[np.float64], like: Camera) -> Camera:
    """The view as COLMAP places it, with the intrinsics K that it used."""
    pose = image.cam_from_world().matrix()
    return replace(like, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2], R=pose[:, :3], t=pose[:, 3])


def _at(picture: Float32, xy: NDArray[np.float64]) -> float:
    u, v = np.clip(xy.astype(int), 0, [picture.shape[1] - 1, picture.shape[0] - 1])
    return float(picture[v, u])


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
