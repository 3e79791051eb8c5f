"""Write the home page's video from a run of `run-benchmark`: `python docs/home_video.py SCENE RUN OUT.webp METHOD ...`.

The first column has the truth of the held-out camera and, below, the spikes that it fired in that tick. Each method has
a column: its images, and below them their absolute errors, all on one scale.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from spike4dgs.benchmark import open_scene
from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.reports.error_map import error_image
from spike4dgs.benchmark.scene.images import encode_srgb, read_exr
from spike4dgs.benchmark.scene.scene import Scene, Target

ZOOM, GAP, LINE = 2, 8, 30  # pixels of the video for one of the image, between panels, of a line of text
SCALE = 0.1  # the error of the brightest colour, in radiance
FRAME_MS, LAST_MS = 140, 900
GROUND, TEXT = (18, 18, 18), (235, 235, 235)


def columns(scene: Scene, run: Path, methods: list[str], target: Target) -> list[tuple[str, UInt8, str, UInt8]]:
    """Return name, image, name and image [H, W, 3] of each column at one target."""
    truth = scene.ground_truth(target)
    spikes = scene.stream(target.camera).window(target.tick, target.tick + 1)[0]
    found = [("truth", _gray(encode_srgb(truth)), "spikes of one tick", _gray(spikes * np.uint8(255)))]
    for method in methods:
        name = f"{target.name}.exr"
        image = read_exr(run / "predictions" / method / scene.id / name, (truth.shape[0], truth.shape[1]))
        errors = error_image(image, truth, SCALE)
        found.append((method, _gray(encode_srgb(image)), f"its error, 0 to {SCALE:g}", errors))
    return found


def frame(panels: list[tuple[str, UInt8, str, UInt8]], time: str) -> Image.Image:
    """Return one frame of the video."""
    height, width = (ZOOM * n for n in panels[0][1].shape[:2])
    out = Image.new("RGB", (GAP + len(panels) * (width + GAP), 2 * (LINE + height) + GAP), GROUND)
    draw, font = ImageDraw.Draw(out), ImageFont.load_default(20)
    for k, (above, image, below, errors) in enumerate(panels):
        x = GAP + k * (width + GAP)
        for y, text, pixels in ((0, above + time * (k == 0), image), (LINE + height, below, errors)):
            draw.text((x, y + LINE / 2), text, fill=TEXT, font=font, anchor="lm")
            out.paste(Image.fromarray(pixels).resize((width, height), Image.Resampling.NEAREST), (x, y + LINE))
    return out


def _gray(image: UInt8) -> UInt8:
    return image[..., None].repeat(3, -1)


def main(folder: str, run: str, path: str, *methods: str) -> None:
    """Write the video."""
    scene = open_scene(folder)
    targets = sorted(scene.targets)
    frames = [
        frame(columns(scene, Path(run), list(methods), target), f" at {scene.t_us(target.tick) / 1000:.0f} ms")
        for target in targets
    ]
    times = [FRAME_MS] * (len(frames) - 1) + [LAST_MS]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=times, loop=0, quality=72, method=6)


if __name__ == "__main__":
    main(*sys.argv[1:])
