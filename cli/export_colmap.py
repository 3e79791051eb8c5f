"""`export-colmap`: images from spikes with a COLMAP model.

    OUT/images/CAMERA/TICK.png
    OUT/sparse/0/cameras.bin, images.bin, points3D.bin, ...

In the model, images are called `CAMERA/TICK.png`. All images of a camera share one camera and one pose. The camera is a
PINHOLE; with lens distortion it is an OPENCV camera (FULL_OPENCV if k3 is not 0), and images are not undistorted.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tyro.conf import Positional

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import filling
from spike4dgs.benchmark.scene.images import encode_srgb, write_png
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.benchmark.scene.writer import write_colmap
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.repair import fill_gaps
from spike4dgs.cli.options import check_names

_EVERY = 20  # ticks: 1 ms at 20 kHz


def export_colmap(
    scene: Positional[Path],
    out: Path,
    *,
    images: str = "tfp",
    ticks: tuple[int, ...] = (),
    every: int | None = None,
    split: str | None = None,
    allow_gaps: bool = False,
) -> int:
    """Write images of the training cameras, made from their spikes, with a COLMAP model of their poses.

    COLMAP and programs that read its models can open OUT, with images/ and sparse/0. The model has no points; COLMAP's
    `point_triangulator` finds some. Images are 8-bit sRGB, clipped at white. Held-out cameras, ground truth and
    calibration recordings are left out.

    Args:
        scene: Scene folder.
        out: New folder to write.
        images: The image maker, such as tfp or tfi.
        ticks: Ticks of the images; give these or --every.
        every: Ticks from one image of a camera to the next; 20 if neither is given.
        split: Training cameras; the scene's default split if left out.
        allow_gaps: Accept a recording with gaps. Images at missing ticks are left out.
    """
    opened = open_scene(scene, allow_gaps, split)
    check_names("--images", [images], IMAGES)
    chosen = _ticks(ticks, every, opened.n_ticks)
    if not any(present(s.gaps, s.n_ticks)[chosen].any() for s in map(opened.stream, opened.train)):
        fix = "choose other --ticks or another --every"
        raise problem(scene, "a tick with data among those of the images", "none", fix)
    cameras = [opened.cameras[camera] for camera in opened.train]
    with filling(out):
        written = {camera.id: _write_images(out / "images", opened, camera.id, images, chosen) for camera in cameras}
        write_colmap(out / "sparse" / "0", cameras, np.zeros((0, 3)), written)
    print(f"{out / 'images'}: {sum(map(len, written.values()))} {images} images of {len(cameras)} cameras")
    print(f"{out / 'sparse' / '0'}: COLMAP model of their poses, without points")
    if opened.test:
        print(f"left out: {', '.join(opened.test)}, held out by the split {opened.split}")
    return 0


def _ticks(ticks: Sequence[int], every: int | None, n_ticks: int) -> list[int]:
    if ticks and every is not None:
        raise problem("--ticks and --every", "one of them", "both", "leave one out")
    if every is not None and every < 1:
        raise problem("--every", "1 tick or more", str(every), "correct it")
    chosen = sorted(set(ticks)) or list(range(0, n_ticks, every or _EVERY))
    if outside := [tick for tick in chosen if not 0 <= tick < n_ticks]:
        raise problem("--ticks", f"ticks of the clip, 0 to {n_ticks - 1}", str(outside[0]), "correct it")
    return chosen


def _write_images(folder: Path, scene: Scene, camera: str, maker: str, ticks: Sequence[int]) -> list[str]:
    """Write a camera's images, and return their names in the model."""
    stream, names = scene.stream(camera), list[str]()
    seen, stream = present(stream.gaps, stream.n_ticks), fill_gaps(stream)
    for tick in (tick for tick in ticks if seen[tick]):
        names.append(f"{Target(camera, tick).name}.png")
        write_png(folder / names[-1], encode_srgb(IMAGES[maker](stream, [tick], scene.radiance_gain)[0]))
    return names
