"""Gaussians that are hard to render: random ones, and a scene for each way to get a rasteriser wrong, all float64."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.splat import Splats, Views

WIDTH, HEIGHT, FOCAL = 100, 70, 100.0


def random_splats(n: int, channels: int = 1, seed: int = 0) -> Splats:
    """Return Gaussians of all sizes in front of the cameras and a little outside of their image, float64."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    z = 2 + 3 * torch.rand(n, 1, generator=g, dtype=torch.float64)
    sideways = (torch.rand(n, 2, generator=g, dtype=torch.float64) - 0.5) * torch.tensor([1.2, 0.9])
    means = torch.cat([sideways * z, z], 1)
    scales = torch.exp(0.6 * normal(n, 3) - 2.8)
    return Splats(means, normal(n, 4), scales, torch.sigmoid(1.5 * normal(n)), torch.sigmoid(normal(n, channels)))


def views(count: int = 2) -> Views:
    """Return cameras side by side, turned by a few degrees, that see the Gaussians of `random_splats`."""
    w2c = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    for c in range(count):
        a = 0.08 * (c - (count - 1) / 2)
        w2c[c, 0, 0], w2c[c, 0, 2], w2c[c, 2, 0], w2c[c, 2, 2] = math.cos(a), math.sin(a), -math.sin(a), math.cos(a)
        w2c[c, 0, 3], w2c[c, 2, 3] = -3.5 * math.sin(a), 3.5 - 3.5 * math.cos(a)
    K = torch.tensor([[FOCAL, 0.0, WIDTH / 2], [0.0, 1.1 * FOCAL, 0.45 * HEIGHT], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return Views(w2c, K.repeat(count, 1, 1), WIDTH, HEIGHT)


BARREL = (-0.35, 0.05, 0.01, -0.02, 0.0)  # folds at 1.16, a little beyond the image's corners, and is decentred
CUSHION = (0.3, 0.1, -0.01, 0.02, 0.05)
LENSES = {"barrel": BARREL, "cushion": CUSHION, "tangential": (0.0, 0.0, 0.05, -0.08, 0.0)}


def through(v: Views, *lenses: tuple[float, ...]) -> Views:
    """Return the same views through lenses, one for each or one for all."""
    fx, fy, cx, cy = v.K[0][[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    own = lenses * (len(v) // len(lenses))
    pose = np.eye(3), np.zeros(3)
    cameras = [Camera(str(i), v.width, v.height, fx, fy, cx, cy, *pose, lens) for i, lens in enumerate(own)]
    return replace(Views.from_cameras(cameras), w2c=v.w2c)


def changed(splats: Splats, **tensors: Tensor) -> Splats:
    """Return the same Gaussians with some tensors replaced."""
    names = ("means", "quats", "scales", "opacities", "colors")
    return Splats(**{name: tensors.get(name, getattr(splats, name)) for name in names})


def near_plane() -> tuple[Splats, Views]:
    """Return centres from behind the camera to just in front of it, some closer than the near plane."""
    s = random_splats(60, seed=1)
    z = torch.linspace(-1.0, 0.6, 60, dtype=torch.float64)
    z[::7] = 0.0101  # just visible: projected hundreds of pixels wide
    return changed(s, means=torch.cat([s.means[:, :2] * 0.05, z[:, None]], 1), scales=s.scales * 0.1), views(1)


def needles() -> tuple[Splats, Views]:
    """Return Gaussians with one axis ten thousand times the others."""
    s = random_splats(80, seed=2)
    return changed(s, scales=torch.tensor([3.0, 3e-4, 3e-4], dtype=torch.float64).expand(80, 3)), views()


def pancakes() -> tuple[Splats, Views]:
    """Return flat discs in all orientations, a third of them seen exactly edge-on."""
    s = random_splats(60, seed=3)
    quats = s.quats.clone()
    quats[::3] = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64)  # the thin axis up: a line across the image
    return changed(s, quats=quats, scales=torch.tensor([2.0, 2.0, 1e-5], dtype=torch.float64).expand(60, 3)), views()


def tiny_and_huge() -> tuple[Splats, Views]:
    """Return standard deviations of 1e-6 and of 1e3, alone and within one Gaussian."""
    s = random_splats(60, seed=4)
    scales = torch.full((60, 3), 1e-6, dtype=torch.float64)
    scales[20:40] = 1e3
    scales[40:50, 0] = 1e3
    scales[50:, :2] = 1e3
    return changed(s, scales=scales, opacities=s.opacities * torch.where(scales[:, 0] > 1, 0.2, 1.0)), views()


def opacities() -> tuple[Splats, Views]:
    """Return opacities 0, at the visibility limit, just above it, almost 1, and 1."""
    s = random_splats(100, seed=5)
    values = torch.tensor([0.0, 1 / 255, 0.00393, 0.9989, 0.9991, 0.999999, 1.0], dtype=torch.float64)
    return changed(s, opacities=values[torch.arange(100) % 7], scales=s.scales * 2), views()


def equal_depths() -> tuple[Splats, Views]:
    """Return centres at one depth, and pairs at one point: the order is the index."""
    s = random_splats(90, seed=6)
    means = s.means.clone()
    means[:, 2] = 4.1
    means[1::2] = means[::2]
    return changed(s, means=means), views(1)


def off_screen() -> tuple[Splats, Views]:
    """Return Gaussians out of view: beside, above, behind."""
    s = random_splats(30, seed=7)
    means = s.means.clone()
    means[:10, 0] += 50
    means[10:20, 1] -= 50
    means[20:, 2] -= 50
    return changed(s, means=means), views()


def nothing() -> tuple[Splats, Views]:
    """Return no Gaussian at all."""
    return random_splats(0), views()


def far_origin() -> tuple[Splats, Views]:
    """Return the random scene, moved with its cameras to 1e4 m from the world's origin."""
    s, v = random_splats(150, seed=8), views()
    away = torch.tensor([7e3, -5e3, 6e3], dtype=torch.float64)
    w2c = v.w2c.clone()
    w2c[:, :3, 3] -= w2c[:, :3, :3] @ away
    return changed(s, means=s.means + away), Views(w2c, v.K, v.width, v.height)


def opaque_stack() -> tuple[Splats, Views]:
    """Return hundreds of opaque Gaussians behind each other: every pixel is finished early."""
    s = random_splats(400, seed=9)
    return changed(s, opacities=0.5 + 0.5 * s.opacities, scales=s.scales * 3), views()


def crowd() -> tuple[Splats, Views]:
    """Return 100,000 Gaussians in front of one pixel of an image of 5x3, one behind the other."""
    s = random_splats(100_000, seed=11)
    z = torch.linspace(2, 5, 100_000, dtype=torch.float64)[torch.randperm(100_000, generator=_generator(12))]
    means = torch.stack([1e-3 * s.means[:, 0], 1e-3 * s.means[:, 1], z], 1)
    faint = 0.006 + 0.01 * s.opacities  # hundreds count before a pixel is full
    K = torch.tensor([[FOCAL, 0.0, 2.5], [0.0, FOCAL, 1.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return changed(s, means=means, scales=torch.ones_like(means), opacities=faint), Views(views(1).w2c, K[None], 5, 3)


def behind() -> tuple[Splats, Views]:
    """Return Gaussians behind the camera alone, huge ones among them that would cover the image."""
    s = random_splats(40, seed=13)
    means = s.means * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    huge = torch.where(torch.arange(40) % 2 > 0, 100.0, 1.0)[:, None]
    return changed(s, means=means, scales=s.scales * huge), views(1)


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def zero_quaternions() -> tuple[Splats, Views]:
    """Return Gaussians of which a third have no rotation: those are not rendered."""
    s = random_splats(30, seed=10)
    quats = s.quats.clone()
    quats[::3] = 0
    return changed(s, quats=quats), views()


Hard = Callable[[], tuple[Splats, Views]]
HARD: list[Hard] = [near_plane, needles, pancakes, tiny_and_huge, opacities, equal_depths, off_screen, nothing]
HARD += [far_origin, opaque_stack, zero_quaternions, behind]
