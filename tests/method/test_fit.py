"""The recipes as they are listed, on a world with known images: from spikes to held-out views."""

from functools import cache

import numpy as np
import pytest
import torch
from toy_world import ToyWorld

from spike4dgs.benchmark.method import Budget, FitRequest, Model, find_methods
from spike4dgs.method.models.fitted_model import FittedModel
from spike4dgs.method.splat import PixelFilter, set_threads
from spike4dgs.method.splat.kernels.threads import get_threads

METHODS = find_methods()

WORLD = ToyWorld(width=64, height=40, n_ticks=240, travel=0.4)  # 10 px in 12 ms
SHORT = Budget(scale=0.005)


@cache
def fitted(name: str) -> tuple[Model, tuple[float, ...]]:
    """A model and the losses that its fit reported."""
    losses: list[float] = []

    def note(done: int, total: int, note: str = "") -> None:
        if note.startswith("loss "):
            losses.append(float(note.split()[1].rstrip(",")))

    return METHODS[name].fit(WORLD.training, FitRequest(Budget(scale=0.2), progress=note)), tuple(losses)


@cache
def psnr(name: str, moving: bool) -> float:
    return WORLD.psnr(fitted(name)[0], moving)


@pytest.mark.slow
@pytest.mark.parametrize("moving", [False, True])
def test_a_deforming_scene_beats_a_static_one_and_the_nearest_view(moving: bool) -> None:
    ours, static, nearest = (psnr(name, moving) for name in ("tfp+4dgs", "tfp+static", "nearest-view"))
    print(f"moving={moving}: tfp+4dgs {ours:.2f}, tfp+static {static:.2f}, nearest-view {nearest:.2f} dB")
    assert ours > nearest + 3
    assert ours > static + (2 if moving else 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tfp+4dgs", "tfp+static"])
def test_the_loss_falls(name: str) -> None:
    losses = fitted(name)[1]
    quarter = len(losses) // 4
    assert np.mean(losses[-quarter:]) < 0.75 * np.mean(losses[:2])


def test_a_model_has_the_filter_that_its_recipe_fits_with() -> None:
    """A published row's is customary; the reference method's is a pixel's own."""
    request = FitRequest(SHORT)
    for name, expected in (("tfp+4dgs", PixelFilter()), ("spike4dgs-x", PixelFilter(1 / 12, compensated=True))):
        model = METHODS[name].fit(WORLD.training, request)
        assert isinstance(model, FittedModel) and model.pixel_filter == expected


@pytest.mark.slow
def test_a_model_renders_the_same_bits_again_and_stops_at_the_ends_of_the_clip() -> None:
    model, end = fitted("tfp+4dgs")[0], WORLD.training.duration_us
    images = {t: model.render(WORLD.held_out, t) for t in (-1e6, 0.0, 0.5 * end, end, 1e9)}
    np.testing.assert_array_equal(images[-1e6], images[0.0])
    np.testing.assert_array_equal(images[1e9], images[end])
    np.testing.assert_array_equal(model.render(WORLD.held_out, 0.5 * end), images[0.5 * end])
    assert not np.array_equal(images[0.0], images[end])


def bits(seed: int = 0, name: str = "tfp+4dgs") -> dict[str, torch.Tensor]:
    model = METHODS[name].fit(WORLD.training, FitRequest(SHORT, seed=seed))
    assert isinstance(model, FittedModel)
    (gaussians,) = model.pieces
    return {**gaussians.tensors(), **model.motion.state_dict()}


def test_cores_do_not_change_a_bit_and_the_seed_does() -> None:
    kernels, torchs = get_threads(), torch.get_num_threads()
    try:
        set_threads(1)
        torch.set_num_threads(1)
        one = bits()
        set_threads(2)
        torch.set_num_threads(2)
        two = bits()
        assert torch.get_num_threads() == 2  # as it was before the fit
    finally:
        set_threads(kernels)
        torch.set_num_threads(torchs)
    assert one.keys() == two.keys() and all(torch.equal(v, two[k]) for k, v in one.items())
    other = bits(seed=1)
    assert not torch.equal(other["planes.space.0"], one["planes.space.0"])
    assert not torch.equal(other["means"][:50], one["means"][:50])
