"""A fit of a scene that a lamp lights in part, beside one that takes the lamp's course for that of all light."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from toy_fits import QUICK, request
from toy_world import ToyWorld

from spike4dgs.benchmark.method import Recipe
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.fit import Parts, RecipeMethod
from spike4dgs.method.images.intervals import INTERVALS
from spike4dgs.method.models.fitted_model import FittedModel
from spike4dgs.method.motion.table import MOTIONS
from spike4dgs.method.splat import Views
from spike4dgs.method.starts.base import Initialization, Start
from spike4dgs.method.supervision.table import SUPERVISIONS


@dataclass(frozen=True)
class LampWorld(ToyWorld):
    """The toy world beside a lamp that lights what is to the right by up to half, in two pulses."""

    def trace(self, camera: Camera, t: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        image, depth, board = super().trace(camera, t)
        v, u = np.mgrid[: camera.height, : camera.width].reshape(2, -1)
        x = camera.unproject(np.stack([u, v], -1) + 0.5, depth[v, u])[:, 0].reshape(image.shape)
        share = np.clip(0.25 + 0.4 * x, 0.02, 0.5)
        lamp = np.sin(2 * np.pi * t + 0.9) ** 4 * 8 / 3  # 1 in the mean, and about 1 in the middle
        return image * (1 + share * (lamp - 1)), depth, board


WORLD = LampWorld(width=64, height=42, n_ticks=240, travel=0.3)
TRUE = Initialization(lambda r: Start(r.scene.cameras, *WORLD.surfaces(r.scene.cameras[::2], 0.01, 0)))
PARTS = Parts({"intervals": INTERVALS}, {"true": TRUE}, MOTIONS, SUPERVISIONS)


def fitted(apart: bool, supervision: str = "pixel", steps: int = 70) -> FittedModel:
    coarse = 3 * steps // 10
    own = {"trainer.coarse_steps": coarse, "trainer.fine_steps": steps - coarse, "trainer.freeze_background": True}
    method = RecipeMethod(Recipe("test", "intervals", "true", "paths", supervision, {**QUICK, **own}), PARTS)
    method.algorithm = replace(method.algorithm, layers=apart)
    model = method.fit(WORLD.training, request())
    assert isinstance(model, FittedModel)
    return model


def check_splats(model: FittedModel) -> None:
    """What a viewer takes is lit as the render: `splats` has one gray value, `_render` both layers."""
    camera = WORLD.held_out
    views = Views.from_cameras([camera])
    for share in (0.25, 0.5):
        t_us = share * WORLD.training.duration_us
        image = model.render(camera, t_us)
        np.testing.assert_array_equal(model.render(camera, t_us), image)  # the background is kept now
        splats = model.splats(t_us)
        assert splats.colors.shape[1] == 1
        np.testing.assert_allclose(model.rendered(splats, views)[0].detach().clamp(min=0).numpy(), image, atol=1e-5)


def test_each_gaussian_has_a_share_of_the_lamp_and_splats_are_lit_as_the_render(capsys) -> None:
    own = fitted(apart=True)
    assert "the light of a part of the scene changes" in capsys.readouterr().err
    assert own.background.colors.shape[1] == 2 and own.light is not None
    # What is to the right has more of the lamp, and what does not move is no foreground because its light changes.
    right = own.background.means[:, 0] > 0.4
    share = own.background.colors[:, 1] / own.background.colors[:, 0]
    assert share[right].median() > 3 * share[own.background.means[:, 0] < -0.4].median()
    assert len(own.background) > len(own.pieces[0])
    whole = fitted(apart=False)
    assert "fitted in its mean" in capsys.readouterr().err
    assert whole.background.colors.shape[1] == 1
    check_splats(own)
    for moving in (False, True):
        assert WORLD.psnr(own, moving) > WORLD.psnr(whole, moving) + 2


def test_images_beside_a_loss_of_spikes_have_the_light_of_the_spikes(capsys) -> None:
    assert fitted(apart=False, supervision="spss", steps=10).light is None
    assert "light" not in capsys.readouterr().err
