"""Foreground masks, the points in them, and the window around them, on the toy world."""

from functools import cache

import numpy as np
import pytest
import torch
from toy_world import ToyWorld

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.splat import Views
from spike4dgs.method.training_views import foreground
from spike4dgs.method.training_views.points import variation_at
from spike4dgs.method.training_views.training_images import TrainingImages

WORLD = ToyWorld(width=64, height=40, travel=0.3)
TIMES = np.linspace(0, 1, 7)


@cache
def clip() -> tuple[torch.Tensor, torch.Tensor]:
    """Return noisy images [T, C, H, W] of the toy world, and the pixels of the board at any of the times [C, H, W]."""
    views = [[WORLD.trace(c, t) for c in WORLD.cameras] for t in TIMES]
    images = np.array([[image for image, _, _ in row] for row in views])
    images += np.random.default_rng(0).normal(0, 0.015, images.shape)
    swept = np.array([[board for _, _, board in row] for row in views]).any(0)
    return torch.tensor(images, dtype=torch.float32), torch.from_numpy(swept)


def flat(noise: float, seed: int = 0) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    return torch.tensor(0.5 + noise * rng.normal(size=(9, 2, 30, 50)), dtype=torch.float32)


@pytest.mark.parametrize("noise", [0.0, 0.005, 0.02, 0.04])
def test_noise_alone_is_not_foreground(noise: float) -> None:
    assert not foreground.foreground_masks(flat(noise)).any()


def test_mask_holds_the_path_of_the_board_and_little_else() -> None:
    images, swept = clip()
    masks = foreground.foreground_masks(images)
    assert (masks & swept).sum() > 0.95 * swept.sum()
    around = torch.nn.functional.max_pool2d(swept[:, None].float(), 5, 1, 2)[:, 0] > 0
    assert not (masks & ~around).any()  # blur and growth, one pixel each


def test_inside_of_a_uniform_object_is_filled() -> None:
    images = flat(0.005)
    for t in range(len(images)):
        images[t, :, 3 + t : 19 + t, 10 + t : 36 + t] = 0.9  # 8x18 pixels never change
    assert foreground.foreground_masks(images)[:, 12:19, 19:36].all()


def test_an_object_that_leaves_the_image_is_not_cut_at_its_edge() -> None:
    images = flat(0.0)
    for t in range(len(images)):
        images[t, :, 10:20, : 2 + 2 * t] = 0.9
    assert foreground.foreground_masks(images)[:, 10:20, 2:17].all()


def test_points_of_the_board_move_and_those_of_wall_and_floor_do_not() -> None:
    images, _ = clip()
    masks = foreground.foreground_masks(images)
    camera = WORLD.held_out
    _, depth, board = WORLD.trace(camera, 0.5)
    v, u = np.mgrid[: camera.height, : camera.width].reshape(2, -1)
    points = torch.from_numpy(camera.unproject(np.stack([u, v], -1) + 0.5, depth[v, u]))
    moving = foreground.foreground_points(points, Views.from_cameras(WORLD.cameras), masks).numpy()
    truth = board.reshape(-1)
    assert moving[truth].mean() > 0.97
    assert moving[~truth].mean() < 0.15  # what the board's rim passes over
    assert np.array_equal(foreground.stray_points(points, Views.from_cameras(WORLD.cameras), masks).numpy(), ~moving)


def test_points_inside_of_a_uniform_object_move_though_their_light_does_not_change() -> None:
    view = Views(torch.eye(4)[None], torch.tensor([[[40.0, 0, 25], [0, 40, 15], [0, 0, 1]]]), 50, 30)
    images = flat(0.005)[:, :1]
    for t in range(len(images)):
        images[t, :, 3 + t : 19 + t, 10 + t : 36 + t] = 0.9
    seen = TrainingImages(view, tuple(range(9)), images, n_ticks=9)
    inside, rim, outside = ((x, y) for x, y in ((27.5, 15.5), (36.5, 15.5), (5.5, 5.5)))
    points = torch.tensor([[(x - 25) / 40, (y - 15) / 40, 1.0] for x, y in (inside, rim, outside)])
    assert foreground.moving_points(points, seen, limit=0.03).tolist() == [True, True, False]
    assert variation_at(points, seen)[0] < 0.01  # by itself it would be taken as still


def test_points_outside_all_images_neither_move_nor_stray() -> None:
    masks = torch.ones(len(WORLD.cameras), WORLD.height, WORLD.width, dtype=torch.bool)
    points = torch.tensor([[0.0, -9.0, 1.0], [50.0, 0.0, 1.0]])
    assert not foreground.foreground_points(points, Views.from_cameras(WORLD.cameras), masks).any()
    assert not foreground.stray_points(points, Views.from_cameras(WORLD.cameras), masks).any()  # they have left


def test_window_shows_the_same_pixels_along_the_same_rays() -> None:
    images, swept = clip()
    views = Views.from_cameras(WORLD.cameras)
    window = foreground.moving_window(views, swept, 3)
    width, height = window.views.width, window.views.height
    assert width < WORLD.width and height < WORLD.height
    assert window.cut(swept).sum() == swept.sum()
    for c, (camera, (x, y)) in enumerate(zip(WORLD.cameras, window.corner, strict=True)):
        K, w2c = window.views.K[c].numpy(), window.views.w2c[c].numpy()
        cut = Camera("cut", width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], w2c[:3, :3], w2c[:3, 3])
        there, _ = camera.project(np.array([[0.1, 0.0, 0.5]]))
        here, _ = cut.project(np.array([[0.1, 0.0, 0.5]]))
        np.testing.assert_allclose(here, there - [x, y], atol=1e-9)
        assert torch.equal(window.cut(images)[2, c], images[2, c, y : y + height, x : x + width])


def test_window_without_motion_is_the_whole_image_and_a_margin_ends_at_its_edge() -> None:
    views = Views.from_cameras(WORLD.cameras[:2])
    masks = torch.zeros(2, WORLD.height, WORLD.width, dtype=torch.bool)
    assert foreground.moving_window(views, masks, 4).views is views
    masks[0, :3, 60:] = True  # the other view sees nothing move
    window = foreground.moving_window(views, masks, 2)
    assert (window.views.width, window.views.height) == (8, 7)
    assert window.corner == ((56, 0), (0, 0))
