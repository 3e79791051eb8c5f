"""Recipes whose initialisation estimates poses: the held-out view's pose is refined before a second scoring.

A model from estimated poses is a little off the calibrated frame in which held-out cameras are given, and a
sharp image rendered half a pixel aside scores badly. Both scores are therefore published: (i) at the calibrated pose,
and (ii) after the pose alone was fitted to pixels of the test view, with the Gaussians frozen (BARF, InstantSplat).
Those pixels are of static things only and of a time that is not scored (`benchmark.refinement` chooses them).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spike4dgs.baselines.tracking.model import TrackedModel
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.method import FitRequest, Model, Recipe
from spike4dgs.benchmark.runs.provenance import Provenance
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.lens import nearest, resample
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.fit import Parts, RecipeMethod
from spike4dgs.method.models.fitted_model import FittedModel
from spike4dgs.method.pose_refinement import rigid_motion
from spike4dgs.method.splat import Views
from spike4dgs.method.torch_state import one_torch_thread
from spike4dgs.method.training_views.pinholes import make_lenses

Float32 = NDArray[np.float32]
Render = Callable[[Views], Tensor]  # one view -> its image [1, H, W], differentiable in `views.w2c`


@dataclass(frozen=True)
class Refinement:
    """Adam on the six numbers of a rigid motion: rotation in radians, translation in units of the scene's depth."""

    steps: int = 100  # BARF
    lr: float = 1e-3  # BARF on synthetic scenes; at a focal length of 225 px about 0.2 px a step
    lr_last: float = 1e-5  # cosine decay, so that noise is averaged at the end


class PosedRecipe(RecipeMethod):
    """A recipe that asks for refined scores too, where its model is one of Gaussians."""

    def __init__(
        self, recipe: Recipe, parts: Parts, refinement: Refinement | None = None, description: str = ""
    ) -> None:
        super().__init__(recipe, parts, description)
        self.refinement = refinement or Refinement()
        self.refines_views = recipe.motion != "radiance-field"  # marching along rays has no gradient in the pose
        if self.refines_views:
            self.params["refinement"] = asdict(self.refinement)

    def fit(self, scene: TrainingScene, request: FitRequest) -> Model:
        """As `RecipeMethod.fit`; the model has `refine`."""
        model = super().fit(scene, request)
        return RefinableModel(model, self.refinement) if isinstance(model, FittedModel | TrackedModel) else model


@dataclass(frozen=True, eq=False)
class RefinableModel:
    """A fitted model that can also estimate the pose of a camera from its image."""

    model: FittedModel | TrackedModel
    refinement: Refinement

    @property
    def size_bytes(self) -> int:
        """The model's own."""
        return self.model.size_bytes

    def render(self, camera: Camera, t_us: float) -> Float32:
        """The model's own."""
        return self.model.render(camera, t_us)

    def save(self, path: Path, provenance: Provenance) -> None:
        """The model's own."""
        self.model.save(path, provenance)

    def refine(self, camera: Camera, image: Float32, background: NDArray[np.bool_], t_us: float) -> Camera:
        """Return the camera near `camera` whose render is most like `image` [H, W]; see `refine_pose`."""
        model = self.model
        with torch.no_grad():
            splats = model.splats(t_us)
        _, z = camera.project(splats.means.double().cpu().numpy())
        depth_m = float(np.median(z[z > 0])) if (z > 0).any() else 1.0

        def render_view(views: Views) -> Tensor:
            return model.rendered(splats, views)

        return refine_pose(render_view, camera, image, background, depth_m, self.refinement, model.device)


def refine_pose(
    render_view: Render,
    camera: Camera,
    image: Float32,
    background: NDArray[np.bool_],
    depth_m: float,
    settings: Refinement,
    device: str = "cpu",
) -> Camera:
    """Return the camera near `camera` that makes mean |rendered - image| over the mask `background` [H, W] smallest.

    The pose is exp(xi) w2c with xi = (rotation, translation / depth_m); the best of all steps is returned, the first
    included, so that refinement never ends worse than it began. A lens is taken out of image and mask first. Raises
    UserError where the mask is empty.
    """
    shape = (camera.height, camera.width)
    if image.shape != shape or background.shape != shape or not background.any():
        found = f"{image.shape}, {background.shape}, {int(background.sum())} background pixels"
        expected = f"an image and a mask of shape {shape} with background pixels"
        raise problem("pose refinement", expected, found, "check it")
    given = camera
    if camera.distortion:
        (lens,) = make_lenses([camera])
        straight = resample(np.where(background, image, np.nan).astype(np.float32), lens.to_camera)
        background = nearest(background, lens.to_camera) & lens.seen & np.isfinite(straight)
        camera, image = lens.pinhole, np.nan_to_num(straight)
    start = Views.from_cameras([camera], device=device)
    target = torch.as_tensor(image, device=device)[None]
    weight = torch.as_tensor(background, dtype=target.dtype, device=device)[None] / float(background.sum())
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    units = torch.tensor([1.0, 1.0, 1.0, depth_m, depth_m, depth_m], dtype=torch.float64)
    adam = torch.optim.Adam([xi], lr=settings.lr)
    best, best_loss = start.w2c[0].cpu().numpy(), math.inf
    with one_torch_thread():
        for step in range(settings.steps + 1):
            w2c = rigid_motion(xi * units).to(device) @ start.w2c
            loss = ((render_view(Views(w2c, start.K, camera.width, camera.height)) - target).abs() * weight).sum()
            if (value := loss.item()) < best_loss:
                best, best_loss = w2c[0].detach().cpu().numpy(), value
            share = 0.5 * (1 + math.cos(math.pi * step / max(settings.steps, 1)))
            adam.param_groups[0]["lr"] = settings.lr_last + (settings.lr - settings.lr_last) * share
            adam.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            adam.step()
    return replace(given, R=best[:3, :3], t=best[:3, 3])
