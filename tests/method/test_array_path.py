"""The path of an array in closed form: posed cameras and carried splats are the same, and a file keeps it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_world import ToyWorld

from spike4dgs.method.array_path import ArrayPath
from spike4dgs.method.splat import Splats, Views, render

CAMERAS = ToyWorld().cameras[::4]
PIVOT = np.mean([c.center for c in CAMERAS], axis=0)
COEFFICIENTS = np.array(
    [[0.1, -0.2, 0.3, 0.2, 0.1, -0.3], [0.0, 0.3, 0.1, 0.2, 0.0, 0.1], [0.2, 0.0, 0.1, 0.0, 0.3, 0]]
)
PATH = ArrayPath(COEFFICIENTS, PIVOT, 0.45)


def test_a_camera_sees_a_point_of_the_world_where_the_composed_pose_says():
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    for t in (0.0, 0.3, 1.0):
        carried = points @ PATH.to_array(t)[:3, :3].T + PATH.to_array(t)[:3, 3]
        u = t - 0.45
        turn, shift = np.split(COEFFICIENTS[0] * u + COEFFICIENTS[1] * u**2 + COEFFICIENTS[2] * u**3, 2)
        angle, axis = np.linalg.norm(turn), turn / np.linalg.norm(turn)
        d = points - PIVOT
        by_rodrigues = (
            d * np.cos(angle) + np.cross(axis, d) * np.sin(angle) + np.outer(d @ axis, axis) * (1 - np.cos(angle))
        )
        np.testing.assert_allclose(carried, by_rodrigues + PIVOT + shift, atol=1e-12)
        for camera, posed in zip(CAMERAS, PATH.posed(CAMERAS, t), strict=True):
            np.testing.assert_allclose(posed.project(points)[0], camera.project(carried)[0], atol=1e-9)
    np.testing.assert_array_equal(PATH.to_array(0.45), np.eye(4))


def test_carried_splats_look_as_they_do_to_cameras_that_move():
    rng, n = torch.Generator().manual_seed(0), 60
    means = torch.rand(n, 3, generator=rng) * torch.tensor([2.0, 0.5, 1.4]) - torch.tensor([1.0, 0.25, 0.0])
    scales, quats = 0.03 + 0.1 * torch.rand(n, 3, generator=rng), torch.randn(n, 4, generator=rng)
    splats = Splats(means, quats, scales, torch.full((n,), 0.7), torch.rand(n, 1, generator=rng))
    for t in (0.1, 0.9):
        there = render(PATH.carried(splats, t), Views.from_cameras(CAMERAS)).image
        expected = render(splats, Views.from_cameras(PATH.posed(CAMERAS, t))).image
        assert torch.allclose(there, expected, atol=2e-4) and expected.std() > 0.05


def test_gradients_pass_through_what_is_carried():
    means = torch.zeros(1, 3, requires_grad=True)
    one = Splats(means, torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 3), torch.ones(1), torch.ones(1, 1))
    PATH.carried(one, 0.9).means[0, 1].backward()
    np.testing.assert_allclose(means.grad[0], PATH.to_array(0.9)[1, :3], rtol=1e-6)


def test_a_file_keeps_the_path_and_refuses_what_is_none():
    again = ArrayPath.from_tensors(PATH.tensors())
    np.testing.assert_array_equal(again.to_array(0.2), PATH.to_array(0.2))
    for name, wrong in (("pivot", torch.zeros(2)), ("coefficients", torch.full((3, 6), torch.nan))):
        with pytest.raises(ValueError, match="array's path"):
            ArrayPath.from_tensors(PATH.tensors() | {name: wrong})
    assert replace(PATH, time=0.5).to_array(0.5)[0, 0] == 1
