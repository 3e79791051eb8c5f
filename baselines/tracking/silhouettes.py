"""The pixels that Dynamic 3D Gaussians takes for the foreground."""

from __future__ import annotations

from torch import Tensor

from spike4dgs.baselines.images.tfp import TFP
from spike4dgs.method.fit import FitJob
from spike4dgs.method.images.training import make_training_images
from spike4dgs.method.training_views.foreground import foreground_masks


def silhouettes(job: FitJob) -> Tensor:
    """Return the pixels that something moving passes, bool [C, H, W]: of TFP's images at the same ticks.

    Other images may have noise that passes for motion: TFI's grows with the square of the light, and half of a still
    view would be tracked. Where nothing fired, the images are another sensor's, and tell themselves.
    """
    images, scene = job.training_images, job.scene
    if any(stream.packed.any() for stream in scene.streams):
        own = job.settings["images"], job.request.device, job.light
        images = make_training_images(scene, job.start.cameras, TFP, *own)
    return foreground_masks(images.images)
