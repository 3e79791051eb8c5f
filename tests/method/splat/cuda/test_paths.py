"""Every path on a pretended device: nothing mixes its tensors with those of the CPU. See `pretend_device`."""

from pathlib import Path
from typing import Any

import pytest
import saved_models
import torch
from pretend_device import DEVICE, pretend_device
from toy_bursts import write_toy_shard

from spike4dgs.baselines.recipes import PARTS
from spike4dgs.benchmark.method import FitRequest, Recipe, get_method
from spike4dgs.benchmark.scene.training_bursts import open_folder
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.models.saved_model import load_model
from spike4dgs.method.msdi import TINY
from spike4dgs.method.msdi.train import Training, TrainingSettings
from spike4dgs.method.msdi.training_data import Bursts

# Each motion and each loss once: a tensor that is left behind in one of them has nothing to do with the other.
PAIRS = [("hexplane", "spss"), ("spacetime", "pixel+spike"), ("static", "spike-render"), ("tracking", "pixel")]
# One with settings of its own: paths over a frozen background.
METHODS: list[Any] = [RecipeMethod(Recipe("+".join(pair), "tfp", "rig", *pair), PARTS) for pair in PAIRS]
# Of a small field: how much its tensors hold does not matter, only where they lie.
FIELD = {"motion.rays": 16, "motion.coarse_samples": 6, "motion.fine_samples": 4, "motion.width": 16}
METHODS += [RecipeMethod(Recipe("dy-spikenerf", "tfp", "rig", "radiance-field", "spike", FIELD), PARTS)]
METHODS += [get_method("spike4dgs-x")]


@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
def test_a_fit_stays_on_its_device(method: Any) -> None:
    with pretend_device() as device:
        method.warm_up(FitRequest(device=device))


@pytest.mark.parametrize("name", saved_models.MODELS)
def test_a_saved_model_renders_on_its_device(name: str, tmp_path: Path) -> None:
    saved_models.model(name).save(tmp_path / "model", saved_models.provenance())
    with pretend_device() as device:
        image = load_model(tmp_path / "model", device).model.render(saved_models.WORLD.cameras[0], 1000.0)
    assert image.shape == (24, 40)


def test_msdi_trains_on_its_device(tmp_path: Path) -> None:
    write_toy_shard(tmp_path, 13, instants=1)
    data = Bursts(open_folder(tmp_path))
    settings = TrainingSettings(steps=4, views=4, most_views=3, lr_points=4e-3, warm_up=1)
    with pretend_device() as device:
        training = Training(data, TINY, settings, device, seed=1)
        for _ in range(2):
            training.train_step()


def test_the_device_refuses_what_a_gpu_refuses() -> None:
    with pretend_device():
        here, there = torch.ones(3), torch.ones(3, device=DEVICE)
        assert there.device.type == DEVICE and (there + 1).cpu().tolist() == [2, 2, 2]
        for mix in (lambda: here + there, lambda: torch.cat([here, there]), lambda: here[there.long()]):
            with pytest.raises(RuntimeError):
                mix()
        with pytest.raises(TypeError):
            there.numpy()
        with pytest.raises(RuntimeError, match="generator"):
            torch.rand(3, generator=torch.Generator(), device=DEVICE)
