"""Refined scores: held-out cameras at the poses that a model estimates for them, from pixels that are not scored.

A model that estimates poses may have `refine(camera, image, background, t_us) -> Camera`. It gets one image of each
held-out camera, made from its spikes over a time without targets, and the pixels at which nothing moves in any target.
The targets are then rendered from the camera that it returns. Such scores use test pixels, so they have a record of
their own, METHOD.refined, beside the scores at the calibrated pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from spike4dgs.benchmark.arrays import Float32, Mask
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import Scene

SUFFIX = ".refined"
MAX_MS = 10.0  # of the image


def is_refined(name: str) -> bool:
    """Return whether a record's name is of refined scores, which have no rank: a method has one, without them."""
    return name.endswith(SUFFIX)


class Refinable(Protocol):
    """A model that can estimate the pose of an image."""

    def refine(self, camera: Camera, image: Float32, background: Mask, t_us: float) -> Camera:
        """Return a camera near `camera` that renders `image` [H, W] at `t_us`, by the pixels in `background` [H, W]."""
        ...


@dataclass(frozen=True, eq=False)
class View:
    """What a model gets of a held-out camera to estimate its pose; see the module."""

    camera: Camera
    image: Float32  # [H, W]
    background: Mask  # [H, W]
    t_us: float


def views_of(scene: Scene) -> tuple[View, ...]:
    """Return a view of each held-out camera. Raises UserError for one in which every pixel moves."""
    return tuple(_view(scene, name) for name in scene.test)


def _view(scene: Scene, name: str) -> View:
    targets = [t for t in scene.targets if t.camera == name]
    start, stop = free_ticks([t.tick for t in targets], scene.n_ticks, round(scene.rate_hz * MAX_MS * 1e-3))
    image = scene.stream(name).counts(start, stop) / np.float32((stop - start) * scene.radiance_gain)
    background = ~np.any([scene.moving(t) for t in targets], axis=0)
    if not background.any():
        fix = "publish the scores at the calibrated pose only"
        raise problem(f"{scene.id}, {name}", "pixels at which nothing moves", "none", fix)
    t_us = 0.5 * (scene.t_us(start) + scene.t_us(stop))
    return View(scene.cameras[name], image.astype(np.float32), background, t_us)


def refined_cameras(model: Refinable, views: Sequence[View]) -> dict[str, Camera]:
    """Return the cameras of some views at the model's estimates of their poses."""
    return {v.camera.id: model.refine(v.camera, v.image, v.background, v.t_us) for v in views}


def free_ticks(ticks: Sequence[int], n_ticks: int, most: int) -> tuple[int, int]:
    """Return the longest stretch [start, stop) of the clip without any of `ticks`, or `most` ticks in its middle.

    Raises UserError where every tick is taken.
    """
    edges = [-1, *sorted(ticks), n_ticks]
    length, start = max((b - a - 1, -a - 1) for a, b in zip(edges, edges[1:], strict=False))
    if length < 1:
        raise problem("refinement", "ticks that are not scored", "none", "leave some ticks out of the targets")
    spare = max(0, length - most) // 2
    return spare - start, spare - start + min(length, most)
