"""What a sheet and its video show of a scene: truth and every method's images, cropped to what moves, with errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Mask, UInt8
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.error_map import absolute_error, choose_scale, error_image
from spike4dgs.benchmark.runs.record import Cell, Record
from spike4dgs.benchmark.scene.images import encode_srgb, read_exr
from spike4dgs.benchmark.scene.scene import Scene, Target

Value = TypeVar("Value", bound=np.generic)
MARGIN = 0.15  # around what moves, of its size
SMALLEST = 24  # pixels of a crop's side: smaller ones show no context
STILL = (
    1.5  # a box that holds all of the motion stays where it is if its area is at most so many times a following one's
)


class Box(NamedTuple):
    """A part of an image, in pixels; x and y of its upper left corner."""

    x: int
    y: int
    width: int
    height: int

    def of(self, image: NDArray[Value]) -> NDArray[Value]:
        """Return this part of an image [H, W, ...], a view."""
        return image[self.y : self.y + self.height, self.x : self.x + self.width]


def crops(moving: Sequence[Mask]) -> list[Box | None]:
    """Return a box around what moves in each image [H, W] of a clip, all of one size; None where nothing does.

    The box is the same in all images where that costs little (`STILL`), so that the motion is seen; otherwise it
    follows what moves.
    """
    tight = [bounds(mask) for mask in moving]
    known = [box for box in tight if box]
    if not known:
        return [None] * len(tight)
    height, width = moving[0].shape
    following = _widened([b.width for b in known], [b.height for b in known], width, height)
    whole = bounds(np.logical_or.reduce(list(moving)))
    assert whole is not None
    still = _widened([whole.width], [whole.height], width, height)
    if still[0] * still[1] <= STILL * following[0] * following[1]:
        box = _centred(whole, *still, width, height)
        return [box if own else None for own in tight]
    return [_centred(box, *following, width, height) if box else None for box in tight]


def _widened(widths: list[int], heights: list[int], width: int, height: int) -> tuple[int, int]:
    """Return the size of the largest box with its margin, within the image."""
    w, h = (max(SMALLEST, *(round(side * (1 + 2 * MARGIN)) for side in sides)) for sides in (widths, heights))
    return min(width, w), min(height, h)


def _centred(box: Box, w: int, h: int, width: int, height: int) -> Box:
    x, y = box.x + box.width // 2 - w // 2, box.y + box.height // 2 - h // 2
    return Box(min(max(x, 0), width - w), min(max(y, 0), height - h), w, h)


def bounds(mask: Mask) -> Box | None:
    """Return the smallest box around the pixels that are true; None where there are none."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return None
    x, y = int(columns[0]), int(rows[0])
    return Box(x, y, int(columns[-1]) + 1 - x, int(rows[-1]) + 1 - y)


SHOWN = 3  # instants of a sheet


@dataclass(frozen=True, eq=False)
class Panels:
    """The images of the first held-out camera; `folders` and `cells` are by method, in the order of the rows."""

    scene: Scene
    targets: tuple[Target, ...]  # of one camera, by time
    boxes: tuple[Box, ...]  # the crop of each target
    folders: Mapping[str, Path]
    cells: Mapping[str, Cell]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of every crop."""
        return self.boxes[0].width, self.boxes[0].height

    @property
    def is_cropped(self) -> bool:
        """False where the crop is the whole image."""
        camera = self.scene.cameras[self.targets[0].camera]
        return self.size != (camera.width, camera.height)

    @property
    def shown(self) -> list[int]:
        """The numbers of the targets that a sheet shows: spread over the clip without its ends."""
        count = min(SHOWN, len(self.targets))
        return [int(k) for k in (np.arange(count) + 0.5) / count * len(self.targets)]

    @property
    def scored(self) -> list[str]:
        """The methods that have images."""
        return [name for name, cell in self.cells.items() if cell["status"] == "ok"]

    def truth(self, k: int) -> Float32:
        """Return the crop [h, w] of the k-th target's radiance."""
        return self.boxes[k].of(self.scene.ground_truth(self.targets[k]))

    def render(self, name: str, k: int) -> Float32:
        """Return the crop [h, w] of a method's image."""
        whole = self.scene.ground_truth(self.targets[k]).shape
        image = read_exr(self.folders[name] / f"{self.targets[k].name}.exr", (whole[0], whole[1]))
        return self.boxes[k].of(image)

    def image(self, name: str | None, k: int) -> UInt8:
        """Return the crop of a method's image, or of the truth (None), as it is shown: 8-bit sRGB [h, w]."""
        return encode_srgb(self.truth(k) if name is None else self.render(name, k))

    def errors(self, name: str, k: int) -> UInt8:
        """Return the error map of the crop on the method's scale, RGB [h, w, 3]."""
        return error_image(self.render(name, k), self.truth(k), self.scales[name])

    @cached_property
    def scales(self) -> dict[str, float]:
        """The scale of each method's error maps: of all of them, chosen by those that the sheet shows."""
        return {
            name: choose_scale(absolute_error(self.render(name, k), self.truth(k)) for k in self.shown)
            for name in self.scored
        }


def make_panels(scene: Scene, folders: Mapping[str, Path], records: Sequence[Record]) -> Panels:
    """Return the panels of a scene; `folders` maps a method to its predictions of this scene."""
    camera = min(t.camera for t in scene.targets)
    targets = tuple(sorted(t for t in scene.targets if t.camera == camera))
    whole = Box(0, 0, scene.cameras[camera].width, scene.cameras[camera].height)
    found = crops([scene.moving(t) for t in targets])
    sized = next((box for box in found if box), whole)
    # An image where nothing moves shows what the one before it does, so that all crops have one size.
    boxes = [sized]
    for box in found:
        boxes.append(box or boxes[-1])
    cells = {r["method"]["name"]: r["scenes"][scene.id] for r in records}
    return Panels(scene, targets, tuple(boxes[1:]), folders, {name: cells[name] for name in folders})


def score_text(values: Mapping[str, float | None]) -> str:
    """Return PSNR of the whole image and of what moves, for people."""
    psnr, dynamic = METRICS["psnr"], METRICS["psnr_dynamic"]
    return f"{psnr.format(values['psnr'])} dB, moving {dynamic.format(values['psnr_dynamic'])} dB"
