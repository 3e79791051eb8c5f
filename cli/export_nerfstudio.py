"""`export-nerfstudio`: a scene as the images, poses and times that nerfstudio's D-NeRF data parser loads.

    OUT/train/CAMERA_TICK.png, OUT/val/..., OUT/test/...
    OUT/transforms_train.json, OUT/transforms_val.json, OUT/transforms_test.json
    OUT/transforms.json

Each transforms_*.json has one `camera_angle_x`, `w`, `h` and frames of `file_path` (without suffix), `time` and
`transform_matrix` (camera to world, OpenGL axes). Many programs for dynamic scenes read the same layout.

Some of them assume square images, and put the principal point of a wide image too low. transforms.json lists all images
with intrinsics for each (`fl_x`, `fl_y`, `cx`, `cy`, `w`, `h`), and the parts (`train_filenames`, ...). nerfstudio's
other parser and nerfbaselines load it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import Positional

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import filling, write_json
from spike4dgs.benchmark.scene.cameras import Camera, distortion_px, to_nerfstudio
from spike4dgs.benchmark.scene.images import encode_srgb, write_png
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.repair import fill_gaps
from spike4dgs.cli.options import check_names

_TOLERANCE_PX = 0.005  # the most that one focal length and a principal point in the middle may move a pixel
_VAL_EVERY = 5  # training images for one validation image, at a time between them
_LOSSES = """lost on the way:
  - 8-bit sRGB images, clipped at white, for streams and linear radiance
  - one image per window of spikes (blurred by motion within it) for every tick
  - one focal length and the middle as principal point for calibrated intrinsics (others are refused)
  - time as a share of the clip, rounded by readers to float32, for ticks
  - masks, geometry, calibration recordings, points and the other splits stay behind
their parser assumes a scene within 1.5 units of the origin: give it a --scale-factor for a larger one"""


def export_nerfstudio(
    scene: Positional[Path],
    out: Path,
    *,
    images: str = "tfp",
    every: int = 20,
    split: str | None = None,
    colour: bool = False,
    allow_gaps: bool = False,
) -> int:
    """Write a scene as data for nerfstudio's D-NeRF parser (and others that read this layout).

    Training images (and validation images, at times between) are made from the spikes of the training cameras; test
    images are the ground truth of the held-out cameras. The export is lossy: images are 8-bit sRGB, clipped at white,
    one per window of spikes instead of the stream. All cameras must share one focal length and have the principal point
    in the middle. Masks, geometry, calibration and points are left out. To compare methods, score a predictions folder.

    Args:
        scene: Scene folder.
        out: New folder to write.
        images: The image maker for training and validation images, such as tfp or tfi.
        every: Ticks from one training image of a camera to the next; 2 or more.
        split: Training and held-out cameras; the scene's default split if left out.
        colour: Write test images in colour, if the ground truth has it. Spike cameras see gray, so training images
            are gray: compare with gray test images.
        allow_gaps: Accept a recording with gaps. Images at missing ticks are left out.
    """
    opened = open_scene(scene, allow_gaps, split)
    check_names("--images", [images], IMAGES)
    if every < 2:
        raise problem("--every", "2 ticks or more", str(every), "leave room for the validation images between")
    used = [opened.cameras[c] for c in (*opened.train, *opened.test)]
    angle = _angle_x(used, scene)
    ticks = range(0, opened.n_ticks, every)
    between = range(every // 2, opened.n_ticks, _VAL_EVERY * every)
    truth = opened.ground_truth_rgb if colour else opened.ground_truth

    streams = {camera: opened.stream(camera) for camera in opened.train}
    seen = {camera: present(stream.gaps, stream.n_ticks) for camera, stream in streams.items()}
    filled = {camera: fill_gaps(stream) for camera, stream in streams.items()}

    def from_spikes(target: Target) -> Float32:
        return IMAGES[images](filled[target.camera], [target.tick], opened.radiance_gain)[0]

    parts = {
        name: [Target(camera, tick) for camera in opened.train for tick in times if seen[camera][tick]]
        for name, times in (("train", ticks), ("val", between))
    }
    if not parts["train"]:
        raise problem(scene, "a tick with data among those of the training images", "none", "choose another --every")
    tests = [target for target in opened.targets if f"images/{target.name}.exr" in opened.manifest.files]
    with filling(out):
        frames = {"test": [_write(out, "test", opened, target, truth(target)) for target in tests]}
        for name, targets in parts.items():
            frames[name] = [_write(out, name, opened, target, from_spikes(target)) for target in targets]
        for name, of_part in frames.items():  # after all images: what is cut off has no description
            path = out / f"transforms_{name}.json"
            print(f"{path}: {len(of_part)} images" if of_part else f"no {path.name}: the scene has no such images")
            if of_part:  # the parser opens the first image
                write_json(path, _d_nerf(angle, used[0], of_part))
        write_json(out / "transforms.json", _with_intrinsics(frames))
    print(_LOSSES)
    return 0


def _angle_x(cameras: Sequence[Camera], where: Path) -> float:
    """Return the field of view along x in radians that all cameras share. Raises UserError where they share none."""
    first = cameras[0]
    for c in cameras:
        reach = max(c.width, c.height) / 2
        off = {
            "fl_x": abs(c.fx - first.fx) / first.fx * reach,
            "fl_y": abs(c.fy - first.fx) / first.fx * reach,
            "cx": abs(c.cx - c.width / 2),
            "cy": abs(c.cy - c.height / 2),
            "lens distortion": distortion_px(c),
        }
        worst = max(off, key=lambda key: off[key])
        if off[worst] > _TOLERANCE_PX or (c.width, c.height) != (first.width, first.height):
            expected = "pinholes of one size and one focal length, their principal points in the middle"
            found = f"{worst} of {c.id} off by {off[worst]:.3g} px at {c.width}x{c.height}"
            fix = "this format has no other cameras: rectify the images, or use transforms_*.json of the scene"
            raise problem(where, expected, found, fix)
    return 2 * math.atan(0.5 * first.width / first.fx)


def _write(out: Path, part: str, scene: Scene, target: Target, radiance: Float32) -> dict[str, Any]:
    """Write linear radiance [H, W] or [H, W, 3] as a PNG and return its frame of transforms.json."""
    pixels, name = encode_srgb(radiance), f"{part}/{target.camera}_{target.tick:06d}.png"
    rgb = pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)
    write_png(out / name, rgb)
    return {"file_path": name, "time": target.tick / scene.n_ticks, **to_nerfstudio(scene.cameras[target.camera])}


def _with_intrinsics(parts: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Return transforms.json of the frames of each part. A part without images is not listed."""
    names = {f"{part}_filenames": [frame["file_path"] for frame in frames] for part, frames in parts.items() if frames}
    return {**names, "frames": [frame for frames in parts.values() for frame in frames]}


def _d_nerf(angle: float, camera: Camera, frames: list[dict[str, Any]]) -> dict[str, Any]:
    """Return transforms_*.json of frames that share one field of view."""
    listed = [
        {
            "file_path": f"./{frame['file_path'].removesuffix('.png')}",
            "time": frame["time"],
            "transform_matrix": frame["transform_matrix"],
        }
        for frame in frames
    ]
    return {"camera_angle_x": angle, "w": camera.width, "h": camera.height, "frames": listed}
