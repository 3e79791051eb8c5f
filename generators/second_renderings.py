"""Second renderings of a scored image, with random numbers of their own: what they and the truth differ in is noise."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.scene.scene import Scene, Target
from spike4dgs.generators.profiles import RATE_HZ, Job
from spike4dgs.generators.render_tasks import cameras_of, held_out_view, recorded_job, renderer_of

_SEEDS = (1_000_003, 2_000_003)  # added to a scene's seed; its own files use the next few after it


def second_renderings(scene: Scene) -> tuple[Target, NDArray[np.float32], NDArray[np.float32]] | None:
    """Return the middle target of the simulated held-out camera and two renderings of it, linear radiance [H, W].

    Each has the noise of ground truth. None for a scene that no world of this installation made, and
    for a split whose held-out cameras have no target of that camera.
    """
    job = recorded_job(scene.meta["source"])
    if job is None:
        return None
    camera = cameras_of(job)[held_out_view(job)]
    if not (targets := [t for t in scene.targets if t.camera == camera.id]):
        return None
    target, images = targets[len(targets) // 2], []
    print(f"rendering a target of {scene.id} twice more, to know its noise: about half a minute", file=sys.stderr)
    for seed in _SEEDS:
        rendered = second_truth(job, held_out_view(job), job.seed + seed)
        images.append(rendered(target.tick / RATE_HZ) * np.float32(job.light_at(target.tick)))
    return target, images[0], images[1]


def second_truth(job: Job, view: int, seed: int) -> Callable[[float], NDArray[np.float32]]:
    """Return what renders a view [H, W] at a time in seconds with the noise of ground truth and other random numbers.

    All that is systematic is that of ground truth: where light is split, a background of the rig, and maps that its
    views share. Where paths are whole, views share nothing, and every pixel is traced.
    """
    alike: dict[str, Any] = {"truth": True, "color": False, "seed": seed}
    camera = cameras_of(job)[view : view + 1]
    if job.profile.soft is None:
        whole = renderer_of(job, camera, **alike, whole_frames=True)
        return lambda t_s: whole.crn_frames(t_s)[0]
    every: Any = renderer_of(job, cameras_of(job), **alike)
    one = renderer_of(job, camera, **alike, static=every.static.views([view]), maps_of=lambda: every)
    return lambda t_s: one.keys(t_s)[0]
