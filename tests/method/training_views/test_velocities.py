"""Velocities of points on a plane with a known motion, whose images are drawn in closed form, and their Jacobians."""

from dataclasses import replace

import pytest
import torch
from splat_scenes import BARREL, CUSHION, through, views
from torch import Tensor

from spike4dgs.method.splat import Views
from spike4dgs.method.splat.lens import bent, lens_rays
from spike4dgs.method.training_views import velocities
from spike4dgs.method.training_views.training_images import TrainingImages
from spike4dgs.method.training_views.velocities import LEAST_VIEWS, _jacobians, _triangulated, velocities_at

TICKS = tuple(range(50, 400, 50))
VELOCITY = torch.tensor([0.0012, -0.0008, 0.0020], dtype=torch.float64)  # m a tick: two pixels in 50
POINTS = torch.tensor([[0.1, 0.05, 3.5], [-0.4, 0.2, 3.5], [0.35, -0.3, 3.5], [0.0, 0.0, 3.5]], dtype=torch.float64)


def plane(v: Views, tick: float) -> Tensor:
    """Return what views see of a plane of smooth texture that moves, and is 3.5 m away at tick 200: [C, H, W]."""
    moved = VELOCITY * (tick - 200)
    lenses = torch.zeros(len(v), 10, dtype=torch.float64) if v.lenses is None else v.lenses
    rays = lens_rays(v.K, lenses, v.width, v.height).double()  # [C, 3, P]
    R = v.w2c[:, :3, :3]
    origin, toward = -(R.mT @ v.w2c[:, :3, 3:]), R.mT @ rays
    x, y, _ = (origin + (3.5 + moved[2] - origin[:, 2:]) / toward[:, 2:] * toward - moved[:, None]).unbind(1)
    waves = torch.sin(16 * x + 3 * y) + torch.sin(4 * x - 13 * y + 1) + torch.sin(9 * x + 9 * y + 2)
    return (0.5 + 0.14 * waves).reshape(len(v), v.height, v.width)


def images_of(v: Views, ticks: tuple[int, ...] = TICKS) -> TrainingImages:
    return TrainingImages(v, ticks, torch.stack([plane(v, t) for t in ticks]).float(), 400)


@pytest.fixture
def no_prior(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(velocities, "PRIOR", 1e-6)


@pytest.mark.usefixtures("no_prior")
@pytest.mark.parametrize("lenses", [(), (BARREL,), (CUSHION, BARREL, CUSHION, BARREL, CUSHION)])
def test_a_plane_that_moves(lenses: tuple[tuple[float, ...], ...]) -> None:
    v = through(views(5), *lenses) if lenses else views(5)
    found = velocities_at(POINTS.float(), images_of(v), 50)
    assert found.dtype == torch.float32
    assert (found - VELOCITY).norm(dim=1).max() < 0.1 * VELOCITY.norm()  # of depth five views 0.3 m apart know least
    assert (found - VELOCITY)[:, :2].abs().max() < 0.02 * VELOCITY.norm()


def test_depth_is_told_with_caution() -> None:
    found = velocities_at(POINTS, images_of(views(5)), 50)
    assert (found - VELOCITY)[:, :2].abs().max() < 0.06 * VELOCITY.norm()
    share = found[:, 2] / VELOCITY[2]
    assert (share > 0.4).all() and (share < 0.8).all()


@pytest.mark.usefixtures("no_prior")
def test_a_view_that_sees_something_else_does_not_count() -> None:
    images = images_of(views(6))
    other = images.images.clone()
    other[:, 2] = other[:, 2].flip(0)  # goes backwards in time: its flow is the opposite
    found = velocities_at(POINTS, replace(images, images=other), 50)
    assert (found - VELOCITY).norm(dim=1).max() < 0.15 * VELOCITY.norm()


def test_points_that_too_few_views_see_rest() -> None:
    aside = torch.tensor([[0.0, 0.0, 3.5], [30.0, 0.0, 3.5], [0.0, 0.0, -3.5]], dtype=torch.float64)
    found = velocities_at(aside, images_of(views(LEAST_VIEWS)), 50)
    assert found[0].norm() > 0 and not found[1:].any()
    assert not velocities_at(aside, images_of(views(LEAST_VIEWS - 1)), 50).any()


@pytest.mark.usefixtures("no_prior")
def test_a_flow_counts_whole_in_the_outer_half_pixel() -> None:
    v = views(5)
    K = v.K.double()
    K[:, :2, 2] += 0.2 - _jacobians(POINTS[:1], v)[1][:, 0]  # the point is 0.2 px from the corner of each view
    v = replace(v, K=K)
    flow = _jacobians(POINTS[:1], v)[0][:, 0] @ VELOCITY
    found = _triangulated(POINTS[:1], v, flow[..., None, None].expand(-1, -1, v.height, v.width))
    assert (found - VELOCITY).norm() < 0.01 * VELOCITY.norm()


def test_images_that_do_not_reach_far_enough_tell_nothing() -> None:
    assert not velocities_at(POINTS, images_of(views(4), (200,)), 50).any()
    assert not velocities_at(POINTS, images_of(views(4)), 10).any()


@pytest.mark.parametrize(("width", "height"), [(1, 1), (8, 8), (64, 3), (3, 64), (12, 12), (13, 200)])
def test_tiny_views_are_no_error(width: int, height: int) -> None:
    v = replace(views(4), width=width, height=height)
    values = torch.rand(len(TICKS), 4, height, width, generator=torch.Generator().manual_seed(0))
    assert velocities_at(POINTS, TrainingImages(v, TICKS, values, 400), 50).isfinite().all()


@pytest.mark.usefixtures("no_prior")
def test_missing_images_are_left_out() -> None:
    images = images_of(views(5))
    missing = torch.zeros(len(TICKS), 5, dtype=torch.bool)
    missing[TICKS.index(250), :2] = True
    dark = images.images.clone()
    dark[TICKS.index(250), :2] = 0
    found = velocities_at(POINTS, replace(images, images=dark, missing=missing), 50)
    assert (found - VELOCITY).norm(dim=1).max() < 0.1 * VELOCITY.norm()


@pytest.mark.usefixtures("no_prior")
def test_a_gap_of_all_cameras_in_the_middle_moves_the_images_that_tell() -> None:
    images = images_of(views(5))
    missing = torch.zeros(len(TICKS), 5, dtype=torch.bool)
    missing[TICKS.index(200), 2:] = True  # two are too few
    dark = images.images.where(~missing[..., None, None], 0.0)
    found = velocities_at(POINTS, replace(images, images=dark, missing=missing), 50)
    assert (found - VELOCITY).norm(dim=1).max() < 0.2 * VELOCITY.norm()
    assert not velocities_at(POINTS, replace(images, missing=torch.ones_like(missing)), 50).any()


@pytest.mark.parametrize("lens", [None, BARREL, CUSHION])
def test_jacobians_are_those_of_the_projection(lens: tuple[float, ...] | None) -> None:
    v = through(views(3), lens) if lens else views(3)

    def project(points: Tensor) -> Tensor:
        p = points @ v.w2c[:, :3, :3].mT + v.w2c[:, None, :3, 3]
        xy = p[..., :2] / p[..., 2:]
        if v.lenses is not None:
            xy, _ = bent(xy, v.lenses[:, None])
        return xy * v.K[:, None, :2, :2].diagonal(dim1=2, dim2=3) + v.K[:, None, :2, 2]

    J, uv = _jacobians(POINTS, v)
    torch.testing.assert_close(uv, project(POINTS))
    for axis, step in enumerate(1e-6 * torch.eye(3, dtype=torch.float64)):
        difference = (project(POINTS + step) - project(POINTS - step)) / 2e-6
        torch.testing.assert_close(J[..., axis], difference, rtol=1e-7, atol=1e-6)
