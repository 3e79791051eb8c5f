"""True correspondences against closed forms: a plane's homography, a sphere before a wall, points that are hidden."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from toy_world import ToyWorld

from spike4dgs.method.matching.network import points_of_cells
from spike4dgs.method.matching.training.truth import correspond

K = torch.tensor([[70.0, 0, 32], [0, 70.0, 24], [0, 0, 1]], dtype=torch.float64)


def pose(turn: tuple[float, float, float], shift: tuple[float, float, float]) -> torch.Tensor:
    m = np.eye(4)
    m[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    m[:3, 3] = shift
    return torch.from_numpy(m)


def plane_depth(w2c: torch.Tensor, height: int = 48, width: int = 64) -> torch.Tensor:
    """Depth of the plane z = 4 of the world along the camera's axis, at pixel centres."""
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], -1).double() @ torch.linalg.inv(K).T  # z = 1
    world = rays @ w2c[:3, :3]
    center = -w2c[:3, :3].T @ w2c[:3, 3]
    return (4 - center[2]) / world[..., 2]


def test_a_planes_points_move_by_its_homography() -> None:
    a, b = pose((0, 0, 0), (0, 0, 0)), pose((0.02, -0.1, 0.05), (0.4, 0.1, -0.2))
    at = points_of_cells(12, 16).double()
    found = correspond(at, (plane_depth(a), plane_depth(b)), (K, K), b @ torch.linalg.inv(a))
    H = K @ (b[:3, :3] + b[:3, 3:] @ torch.tensor([[0, 0, 0.25]], dtype=torch.float64)) @ torch.linalg.inv(K)
    there = torch.cat([at, torch.ones(len(at), 1)], 1) @ H.T
    expected = there[:, :2] / there[:, 2:]
    np.testing.assert_allclose(found.uv, expected, atol=1e-9)
    inside = ((expected >= 0) & (expected < torch.tensor([64.0, 48]))).all(1)
    assert 0.5 < inside.double().mean() < 1 and (found.seen == inside).all()


def test_hidden_points_and_empty_pixels_are_not_seen() -> None:
    a, b = pose((0, 0, 0), (0, 0, 0)), pose((0, 0, 0), (-0.5, 0, 0))
    depth_a, depth_b = plane_depth(a), plane_depth(b)
    depth_b[:, 20:30] = 2.0  # a post that only b has in front of the wall
    depth_a[10:20] = torch.inf
    at = points_of_cells(12, 16).double()
    found = correspond(at, (depth_a, depth_b), (K, K), b)
    row, u = at[:, 1] - 0.5, found.uv[:, 0]
    hidden = (u > 21) & (u < 29)
    assert hidden.any() and not found.seen[hidden].any()
    assert not found.seen[(row >= 10) & (row < 20)].any()
    assert found.seen[(u > 32) & (u < 63) & (row >= 20)].all()


def test_the_toy_worlds_views_agree() -> None:
    world = ToyWorld(width=64, height=48)
    traced = [world.trace(camera, 0.4) for camera in world.cameras[:2]]
    depth = [torch.from_numpy(np.asarray(d, np.float64)) for _, d, _ in traced]
    a, b = (torch.from_numpy(c.w2c) for c in world.cameras[:2])
    intrinsics = [torch.from_numpy(c.K) for c in world.cameras[:2]]
    at = points_of_cells(12, 16).double()
    there = correspond(at, (depth[0], depth[1]), (intrinsics[0], intrinsics[1]), b @ torch.linalg.inv(a))
    assert there.seen.double().mean() > 0.5
    # The point that b sees there, at the centre of the nearest pixel, is seen by a within that pixel's size.
    centre = there.uv[there.seen].floor() + 0.5
    back = correspond(centre, (depth[1], depth[0]), (intrinsics[1], intrinsics[0]), a @ torch.linalg.inv(b))
    off = torch.linalg.vector_norm(back.uv - at[there.seen], dim=1)
    assert off.quantile(0.9) < 1.5
