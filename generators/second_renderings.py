"""Second renderings of a scored image, with random numbers of their own: what they and the truth differ in is noise."""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.scene.scene import Scene, Target
from spike4dgs.generators.profiles import RATE_HZ
from spike4dgs.generators.render_tasks import cameras_of, held_out_view, recorded_job, renderer_of

_SEEDS = (1_000_003, 2_000_003)  # added to a scene's seed; its own files use the next few after it


def second_renderings(scene: Scene) -> tuple[Target, NDArray[np.float32], NDArray[np.float32]] | None:
    """Return the middle target of the simulated held-out camera and two renderings of it, linear radiance [H, W].

    Each has the samples of ground truth in every pixel. None for a scene that no world of this installation made, and
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
        renderer = renderer_of(job, [camera], truth=True, seed=job.seed + seed, color=False, whole_frames=True)
        images.append(renderer.crn_frames(target.tick / RATE_HZ)[0] * np.float32(job.light_at(target.tick)))
    return target, images[0], images[1]
