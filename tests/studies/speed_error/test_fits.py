from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from spike4dgs.benchmark.method import Budget, FitRequest, find_methods, training_for
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.method.gaussians.density import DensitySettings
from spike4dgs.method.motion.base import Extent
from spike4dgs.method.recipes import SPIKE4DGS_X
from spike4dgs.studies.kit.measurement import Request
from spike4dgs.studies.speed_error.fits import FITS, Trial, cut_in, fitted

METHODS = find_methods()


def test_a_trial_is_the_recipes_fit_judged_against_the_ground_truth(small_scene: Path) -> None:
    scene = open_scene(small_scene)
    request = Request("tiny", 5, "cpu", lambda: small_scene)
    method = METHODS[SPIKE4DGS_X.name]
    model = method.fit(training_for(method, scene.training), FitRequest(Budget(0.004), seed=5))
    whole = fitted(SPIKE4DGS_X, Trial("as it is", {}, 0.004, role="chosen"), scene, request, warm_up=False)
    assert (whole.name, whole.role) == ("as it is", "chosen")
    assert whole.values["gaussians"] == len(model.splats(0.5 * scene.n_ticks / scene.rate_hz * 1e6))
    squares = []
    for target in scene.targets:
        image = model.render(scene.cameras[target.camera], target.tick / scene.rate_hz * 1e6)
        squares.append(np.mean((np.clip(image, 0, 1) - np.clip(scene.ground_truth(target), 0, 1)) ** 2))
    assert math.isclose(whole.values["rms"], math.sqrt(np.mean(squares)), rel_tol=1e-4)
    assert math.isclose(whole.values["psnr"], -20 * math.log10(whole.values["rms"]), rel_tol=1e-9)


@pytest.mark.parametrize("pieces", [1, 3])
def test_a_clip_is_cut_as_asked_whatever_its_length(pieces: int) -> None:
    import torch

    motion = cut_in(pieces)
    extent = Extent(torch.zeros(3), torch.ones(3), 1.0, 80, 40)
    assert motion(extent, motion.defaults, torch.Generator()).pieces == pieces


def test_the_chosen_settings_are_the_recipes() -> None:
    """The page marks what the recipe has; where the recipe changes, this says so."""
    assert SPIKE4DGS_X.settings["density.max_gaussians"] == 36_000
    assert SPIKE4DGS_X.settings["density.max_moving_per_pixel"] == 0.5
    assert "density.max_per_pixel" not in SPIKE4DGS_X.settings and DensitySettings.max_per_pixel == 0.8
    assert SPIKE4DGS_X.settings["trainer.moving_change"] == 0.012
    hexplane = METHODS["tfp+4dgs"].settings["motion"]  # type: ignore[attr-defined]
    assert (hexplane.mlp_width, hexplane.features) == (32, 16)
    assert [m.id for m in FITS] == ["budget", "cap", "freezing", "pieces", "hexplane"]
