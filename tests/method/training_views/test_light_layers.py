"""Images in the light of a lamp: what of their changes is light, and colours of two layers."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from spike4dgs.method.gaussians.parameters import from_points
from spike4dgs.method.splat import Views
from spike4dgs.method.training_views.foreground import moving_points
from spike4dgs.method.training_views.light_layers import factor_at, in_mean_light, lamp_images, lit, with_layers
from spike4dgs.method.training_views.training_images import TrainingImages

N, TICKS = 90, tuple(range(5, 90, 10))
LAMP = 1 + np.sin(np.arange(N) / N * 12)
LAMP /= LAMP.mean()
VIEW = Views(torch.eye(4)[None], torch.tensor([[[40.0, 0, 25], [0, 40, 15], [0, 0, 1]]]), 50, 30)
SHARE = torch.linspace(0, 0.3, 50)  # of each column, the same for all rows


def clip(moves: bool = False) -> TrainingImages:
    """A gray wall that the lamp lights to the right, and a bright square that moves to the left of it."""
    at = torch.tensor([factor_at(LAMP, t / N) for t in TICKS])
    images = (0.5 + (at[:, None] - 1) * SHARE).float()[:, None, None].repeat(1, 1, 30, 1)
    for t in range(len(TICKS) if moves else 0):
        images[t, :, 10:20, 2 + t : 12 + t] = 0.9
    return TrainingImages(VIEW, TICKS, images, N, light=LAMP)


def test_a_factor_is_linear_between_the_middles_of_ticks() -> None:
    factors = np.array([1.0, 2.0, 0.0])
    found = [factor_at(factors, t / 3) for t in (0, 0.5, 1.0, 1.5, 2.0, 3.0)]
    assert found == pytest.approx([1, 1, 1.5, 2, 1, 0])


def test_layers_add_up_in_the_light_of_a_factor() -> None:
    channels = torch.rand(2, 3, 4, 2, generator=torch.Generator().manual_seed(0))
    np.testing.assert_allclose(lit(channels[..., 0], channels, 1.0), channels[..., 0])
    np.testing.assert_allclose(lit(channels[..., 0], channels, 3.0), channels[..., 0] + 2 * channels[..., 1])


def test_what_the_lamp_changes_is_the_slope_of_the_values() -> None:
    change, slope = lamp_images(clip())
    assert change.shape == (len(TICKS),)
    np.testing.assert_allclose(slope[0], SHARE.expand(30, 50), atol=1e-6)
    np.testing.assert_allclose(in_mean_light(clip()).images, 0.5, atol=1e-6)
    steady = replace(clip(), light=None)
    assert in_mean_light(steady) is steady


def test_things_at_rest_do_not_move_because_a_lamp_changes() -> None:
    points = torch.tensor([[(x - 25) / 40, (y - 15) / 40, 1.0] for x, y in ((45.5, 15.5), (12.5, 15.5), (12.5, 25.5))])
    assert moving_points(points, clip(moves=True), limit=0.03).tolist() == [False, True, False]
    assert moving_points(points, replace(clip(moves=True), light=None), limit=0.03)[0], "its light does change"


def test_colours_begin_with_the_layer_that_views_see() -> None:
    points = np.array([[(x - 25) / 40, (y - 15) / 40, 1.0] for x in (5.5, 25.5, 45.5) for y in (5.5, 20.5)], np.float32)
    first = from_points(points, np.full(6, 0.5, np.float32), opacity=0.5)
    colors = with_layers(first, clip()).colors
    np.testing.assert_allclose(colors[:, 0], 0.5)
    np.testing.assert_allclose(colors[:, 1], SHARE[[5, 5, 25, 25, 45, 45]], atol=1e-6)
    assert with_layers(first, replace(clip(), light=None)) is first
