"""What a sheet and its video show of a scene: truth and every method's images, cropped to what moves, with errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.crop import Box, crops
from spike4dgs.benchmark.reports.error_map import absolute_error, choose_scale, error_image
from spike4dgs.benchmark.runs.record import Cell, Record
from spike4dgs.benchmark.scene.images import Float32, UInt8, encode_srgb, read_exr
from spike4dgs.benchmark.scene.scene import Scene, Target

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
