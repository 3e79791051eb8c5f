"""Write the description files of a scene folder around streams and images that a generator or recorder has written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.croissant import write_croissant
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import write_json, write_text, writing
from spike4dgs.benchmark.lazy import kept_sigterm
from spike4dgs.benchmark.scene.cameras import Camera, to_nerfstudio
from spike4dgs.benchmark.scene.lens import Distortion, make_distortion
from spike4dgs.benchmark.scene.manifest import Manifest, write_manifest
from spike4dgs.benchmark.scene.scene import SCHEMA, Target, check_meta
from spike4dgs.benchmark.scene.splits import DEFAULT_SPLIT, Split, check_splits

_POSES = (
    "transforms_*.json: camera to world, OpenGL axes; sparse/0: world to camera, OpenCV axes; pixel centres at +0.5"
)


@dataclass(frozen=True, eq=False)
class SceneDescription:
    """Everything in scene.json, transforms, targets and the COLMAP model that is not a stream or an image.

    `train` and `test` are the default split and name every camera once. `targets` are those of all splits: a split
    has those of its held-out cameras. `extras` become the optional top-level objects of scene.json.
    """

    id: str
    title: str
    licence: str
    cameras: tuple[Camera, ...]
    train: tuple[str, ...]
    test: tuple[str, ...]
    rate_hz: float
    n_ticks: int
    radiance_gain: float
    targets: tuple[Target, ...]
    sensor: dict[str, Any]  # "model" and "rows_bottom_up" are required
    source: dict[str, Any]  # "kind" is required: "mitsuba", "recorder" or "spikecv"
    points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))  # [N, 3] known surface points
    clock: dict[str, Any] = field(default_factory=lambda: {"t0_ns": 0, "source": "simulation"})
    sync: dict[str, Any] = field(default_factory=lambda: {"method": "exact", "max_error_us": 0})
    gaps: tuple[dict[str, Any], ...] = ()
    splits: Mapping[str, Split] = field(default_factory=dict)  # `standard_splits`, or none but the default
    extras: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    kept_back: tuple[str, ...] = ()  # held-out cameras without a stream

    @property
    def all_splits(self) -> dict[str, Split]:
        """All splits by name, the default one first. Raises ValueError where `splits` has another default one."""
        default = Split(self.train, self.test)
        if self.splits.get(DEFAULT_SPLIT, default) != default:
            raise ValueError(f"{DEFAULT_SPLIT} is {default}, and not {self.splits[DEFAULT_SPLIT]}")
        return {DEFAULT_SPLIT: default} | dict(self.splits)

    def targets_of(self, split: Split) -> tuple[Target, ...]:
        """Return the scored images of a split."""
        return tuple(t for t in self.targets if t.camera in split.test)


def stream_name(camera: str) -> str:
    """Return the path of a camera's stream inside the scene folder."""
    return f"spikes/{camera}.dat"


def finish_scene(root: Path, scene: SceneDescription, known: Manifest | None = None) -> Manifest:
    """Write scene.json, transforms, targets, the COLMAP model, README and croissant.json; last of all the manifest.

    The streams, images and everything else are already in `root`; files of another scene that are `known` are not
    hashed again. A folder without manifest.json is an unfinished scene. Raises UserError for facts that no scene has,
    as cameras of two sizes.
    """
    size, splits = scene.cameras[0], scene.all_splits
    meta = {
        **scene.extras,
        "schema": SCHEMA,
        "id": scene.id,
        "title": scene.title,
        "licence": scene.licence,
        "units": "m",
        "world_up": [0, 0, 1],
        "rate_hz": scene.rate_hz,
        "n_ticks": scene.n_ticks,
        "width": size.width,
        "height": size.height,
        "clock": scene.clock,
        "sync": scene.sync,
        "pose_convention": _POSES,
        "sensor": scene.sensor,
        "radiance_gain": scene.radiance_gain,
        "streams": {c.id: stream_name(c.id) for c in scene.cameras if c.id not in scene.kept_back},
        "splits": {name: {"train": list(s.train), "test": list(s.test)} for name, s in splits.items()},
        "default_split": DEFAULT_SPLIT,
        "gaps": list(scene.gaps),
        "source": scene.source,
    }
    check_meta(meta, root / "scene.json")
    check_splits(meta, {c.id: c for c in scene.cameras}, root / "scene.json")
    write_json(root / "scene.json", meta)
    _write_transforms(root, scene)
    _write_targets(root, scene)
    write_colmap(root / "sparse" / "0", scene.cameras, scene.points)
    write_text(root / "README.md", _readme(root, scene))
    write_croissant(root, meta, f"{scene.title}. {_summary(scene)}")
    return write_manifest(root, known)


def _write_targets(root: Path, scene: SceneDescription) -> None:
    """Write the scored images: of the default split, and of those splits that hold out other cameras."""
    lists = {
        name: [{"camera": t.camera, "tick": t.tick} for t in scene.targets_of(split)]
        for name, split in scene.all_splits.items()
        if name == DEFAULT_SPLIT or set(split.test) != set(scene.test)
    }
    default = lists.pop(DEFAULT_SPLIT)
    write_json(root / "targets.json", {"targets": default} | ({"splits": lists} if lists else {}))


def _write_transforms(root: Path, scene: SceneDescription) -> None:
    """Write the default split's streams and targets, and in transforms_all.json every image that there is.

    Images of training cameras stay out of transforms_train.json: they are ground truth, which no method may train on.
    """
    by_id = {c.id: c for c in scene.cameras}
    train = [_frame(scene, by_id[c], 0, stream_name(c)) for c in scene.train]
    test = [_frame(scene, by_id[c], 0, stream_name(c)) for c in scene.test]
    targets = scene.targets_of(scene.all_splits[DEFAULT_SPLIT])
    test += [_frame(scene, by_id[t.camera], t.tick, f"images/{t.name}.exr") for t in targets]
    paths = sorted((root / "images").glob("*/*.exr"))
    images = [_frame(scene, by_id[p.parent.name], int(p.stem), p.relative_to(root).as_posix()) for p in paths]
    model = "OPENCV" if any(c.distortion for c in scene.cameras) else "PINHOLE"
    for name, frames in (("train", train), ("test", test), ("all", images)):
        write_json(root / f"transforms_{name}.json", {"camera_model": model, "frames": frames})


def _frame(scene: SceneDescription, camera: Camera, tick: int, file_path: str) -> dict[str, Any]:
    timing = {"time": tick / scene.n_ticks, "tick": tick, "t_us": tick * 1e6 / scene.rate_hz}
    return {"camera": camera.id, "file_path": file_path, **timing, **to_nerfstudio(camera)}


def write_colmap(
    folder: Path,
    cameras: Sequence[Camera],
    points: NDArray[np.float64],
    images: Mapping[str, Sequence[str]] | None = None,
) -> None:
    """Write cameras.bin, images.bin and points3D.bin with pycolmap: a camera and its images for each view.

    The camera is a PINHOLE, with lens distortion an OPENCV camera, or FULL_OPENCV where k3 is not 0.
    `images` are the names of a camera's images; without them it has one, called like it. Raises UserError where the
    folder cannot be written, or not wholly: pycolmap itself does not notice a full disk.
    """
    with kept_sigterm():
        import pycolmap

    names = {c.id: [c.id] for c in cameras} if images is None else images
    model, image_id = pycolmap.Reconstruction(), 0
    for i, c in enumerate(cameras, start=1):
        kind, lens = _colmap_lens(c)
        params = [c.fx, c.fy, c.cx, c.cy, *lens]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=i, model=kind, width=c.width, height=c.height, params=params)
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(c.R), c.t)
        for name in names[c.id]:
            image_id += 1
            image = pycolmap.Image(image_id=image_id, camera_id=i, name=name)
            model.add_image_with_trivial_frame(image, pose)
    for p in points:
        model.add_point3D(p, pycolmap.Track(), np.full(3, 128, dtype=np.uint8))
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        model.write_binary(str(folder))
        written = pycolmap.Reconstruction(str(folder))
    except (ValueError, RuntimeError, OSError) as e:
        fix = "free some disk space, or choose another folder"
        raise problem(folder, "a folder that a whole COLMAP model can be written to", str(e), fix) from e
    if (written.num_images(), written.num_points3D()) != (image_id, len(points)):
        raise problem(folder, "a whole COLMAP model", "a part of it", "free some disk space, or choose another folder")


def _colmap_lens(camera: Camera) -> tuple[str, tuple[float, ...]]:
    if not camera.distortion:
        return "PINHOLE", ()
    k1, k2, p1, p2, k3 = camera.distortion
    return ("FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)) if k3 else ("OPENCV", (k1, k2, p1, p2))


def colmap_distortion(camera: Any) -> Distortion | None:
    """Return the lens distortion of a pycolmap camera; None where OpenCV's five numbers do not describe it."""
    model, params = camera.model.name, [float(v) for v in camera.params]
    if model in ("SIMPLE_PINHOLE", "PINHOLE"):  # an equidistant lens distorts even with coefficients of zero
        return ()
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        return make_distortion(params[3:])
    if model == "OPENCV" or (model == "FULL_OPENCV" and not any(params[9:])):
        return make_distortion(params[4:9])
    return None


# What a scene may hold beside its streams and descriptions: a path and a sentence for README.md.
_CONTENTS = {
    "images": "`images/CAMERA/TICK.exr`: linear radiance at the start of the tick, 1.0 = white (half float): gray in\n"
    "  channel Y, where it was rendered in colour also R, G, B.",
    "masks": "`masks/CAMERA/TICK.png`: the moving region of the same image (white).",
    "geometry": "`geometry/CAMERA/TICK.exr`: Z, depth along the optical axis in metres (inf: nothing); id, the moving\n"
    "  thing (0: none; names in scene.json); flow.x, flow.y, how far its point moves in pixels in the next 20 ticks.",
    "calibration/flat": "`calibration/flat/CAMERA.dat`: a recording of uniform light, packed like `spikes/`; or its\n"
    "  counts, `.npz`.",
    "calibration/dark": "`calibration/dark/CAMERA.dat`: a recording without light, packed like `spikes/`; or its\n"
    "  counts, `.npz`.",
    "truth": "`truth/CAMERA.npz`: the sensor's true gain and dark maps. Only for scoring a calibration.",
    "truth/array_path.json": "`truth/array_path.json`: transforms to the world that stands still from the frame of\n"
    "  the array, in which the cameras are given.",
    "truth/cameras.json": "`truth/cameras.json`: the true cameras; the poses that methods are given differ from them.",
    "conventional": "`conventional/CAMERA/TICK.png`: what a frame camera sees, 8-bit sRGB, exposed from this tick on.",
    "events": "`events/CAMERA.npz`: an event camera: t (us), x, y (row 0 at the top), p (1: brighter, 0: darker).",
    "sheet.png": "`sheet.png`, `preview.webp`: the scene at a glance.",
}


def _summary(scene: SceneDescription) -> str:
    c, ms = scene.cameras[0], scene.n_ticks * 1000 / scene.rate_hz
    cameras = f"{len(scene.cameras)} spike cameras of {c.width}x{c.height} pixels"
    return f"{cameras}, {scene.n_ticks} ticks at {scene.rate_hz:g} Hz ({ms:g} ms)."


def _readme(root: Path, scene: SceneDescription) -> str:
    contents = "\n".join(f"- {text}" for name, text in _CONTENTS.items() if (root / name).exists())
    splits = "\n".join(
        f"  - `{name}`: train {', '.join(s.train)}; test {', '.join(s.test) or 'none'}"
        for name, s in scene.all_splits.items()
    )
    order = "bottom-up" if scene.sensor["rows_bottom_up"] else "top-down"
    dead = scene.sensor.get("dead_ticks", 0)
    rest = f"\n  A pixel rests for {dead:g} ticks after a spike: a rate r becomes r / (1 + {dead:g} r)." if dead else ""
    return f"""# {scene.title}

Scene `{scene.id}` in the format `{SCHEMA}`. {_summary(scene)}
Licence: {scene.licence}.

- `spikes/CAMERA.dat`: packed streams, 1 bit per pixel, row-major, LSB first, rows {order}, ceil(W*H/8) bytes per
  tick. Radiance L fires {scene.radiance_gain:g} * L spikes per tick and pixel on average, before gain and dark maps.\
{rest}
{contents}
- `scene.json`: everything else about the scene. `manifest.json`: size and SHA-256 of every file, and of the
  content of data that is fitted or scored. The revision of the scene is made of these contents.
- `transforms_train.json`, `transforms_test.json`: poses and intrinsics; `sparse/0`: the same for COLMAP.
  `transforms_all.json`: the same for every image, those at training cameras too, which are not for training.
- `targets.json`: what is scored. Splits, the first is the default:
{splits}
"""
