from dataclasses import replace

import pytest
import torch
from gaussian_clouds import cloud
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional

from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.motion import hexplane
from spike4dgs.method.motion.base import Extent
from spike4dgs.method.motion.hexplane_cpu import sample_levels
from spike4dgs.method.motion.table import MOTIONS

SHAPE = hexplane.HexPlaneShape(spatial=(5, 9), times=7, features=6, width=16)


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def gaussians(n: int = 50) -> Gaussians:
    return replace(cloud(n), extra={})


def motion() -> hexplane.HexPlaneMotion:
    box = Extent(-torch.ones(3), torch.ones(3), 2.0, n_ticks=96, width=27)
    return hexplane.HexPlaneMotion(box, hexplane.HexPlaneSettings(features=6, mlp_width=16), rng())


@pytest.mark.parametrize("t", [0.0, 0.3, 1.0])
def test_initial_deformation_is_exactly_zero(t):
    g = gaussians()
    for name, value in motion().deform(g, t).tensors().items():
        assert torch.equal(value, g.tensors()[name]), name


def test_every_parameter_can_be_deformed_and_learns():
    m, g = motion(), gaussians()
    for head in m.last.values():
        torch.nn.init.ones_(head.weight)
    moved = m.deform(g, 0.4)
    for name, value in moved.tensors().items():
        assert not torch.equal(value, g.tensors()[name]), name
    sum(v.sum() for v in moved.tensors().values()).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in m.parameters())


def test_a_lamps_layer_changes_with_the_lamp_alone():
    m, g = motion(), gaussians()
    torch.nn.init.ones_(m.last["colors"].bias)
    beside = replace(g, colors=torch.cat([g.colors, torch.rand(len(g), 1, generator=rng(3))], dim=1))
    moved = m.deform(beside, 0.5)
    assert torch.equal(moved.colors[:, :1], m.deform(g, 0.5).colors) and torch.equal(
        moved.colors[:, 1], beside.colors[:, 1]
    )


def test_means_move_in_units_of_the_scene():
    m, g = motion(), gaussians()
    torch.nn.init.ones_(m.last["means"].bias)
    assert torch.allclose(m.deform(g, 0.5).means - g.means, torch.tensor(2.0))


def test_time_uses_the_whole_axis():
    planes = hexplane.HexPlane(SHAPE, torch.zeros(3), torch.ones(3), rng())
    with torch.no_grad():
        for p in planes.time:
            p[:] = torch.arange(1.0, 8.0)[None, :, None, None]
    at = torch.full((1, 3), 0.5)
    spatial = planes(at, 0.0)  # the first row is all 1
    for row in range(7):  # every row is read at its own time, the first at 0 and the last at 1
        assert torch.allclose(planes(at, row / 6), spatial * (row + 1) ** 3, rtol=1e-5)


def test_points_outside_the_box_take_its_border():
    planes = hexplane.HexPlane(SHAPE, -torch.ones(3), torch.ones(3), rng())
    inside, outside = torch.tensor([[1.0, -1.0, 0.2]]), torch.tensor([[7.0, -3.0, 0.2]])
    assert torch.allclose(planes(inside, 0.5), planes(outside, 0.5))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 9), st.integers(1, 17), st.sampled_from([0, 1, 40]))
def test_kernel_equals_the_plain_twin_in_value_and_gradient(seed, size, features, n):
    g = rng(seed)
    unit = torch.rand(n, 3, generator=g) * 1.4 - 0.2
    space = torch.randn(3, size, size, features, generator=g)
    lines = torch.randn(3, size, features, generator=g)
    weight = torch.randn(n, features, generator=g)
    results = []
    for fast in (True, False):
        leaves = [x.clone().requires_grad_(True) for x in (unit, space, lines)]
        if fast:
            out = sample_levels(leaves[0], [leaves[2]], [leaves[1]])
        else:
            out = hexplane.sample_level(*(x.double() for x in leaves))
        (out * weight).sum().backward()
        results.append([out.detach().float(), *(x.grad for x in leaves)])
    # Gradients are sums of terms, which may cancel and leave what float32 rounds off: no term is larger than this one.
    largest = [functional.max_pool2d(space.abs().clamp(min=1).movedim(-1, 1), 3, 1, 1).movedim(1, -1)]
    largest += [functional.max_pool1d(lines.abs().clamp(min=1).mT, 3, 1, 1).mT]
    term = size * float((hexplane.sample_level(unit, *largest) * weight.abs()).max()) if n else 0.0
    for fast, slow in zip(*results, strict=True):
        if slow.numel():
            assert float((fast - slow).abs().max()) <= 2e-5 * float(slow.abs().max()) + 4e-7 * term


@pytest.mark.parametrize("features", [4, 16, 19])
def test_levels_stand_side_by_side_and_do_not_mix(features):
    g = rng(4)
    unit, sizes = torch.rand(30, 3, generator=g, requires_grad=True), (3, 6, 11)
    space = [torch.randn(3, r, r, features, generator=g, requires_grad=True) for r in sizes]
    lines = [torch.randn(3, r, features, generator=g, requires_grad=True) for r in sizes]
    weight, leaves = torch.randn(30, 3 * features, generator=g), [unit, *space, *lines]
    together = sample_levels(unit, lines, space)
    alone = torch.cat([sample_levels(unit, [a], [s]) for s, a in zip(space, lines, strict=True)], 1)
    assert torch.equal(together, alone)
    gradients = (torch.autograd.grad((x * weight).sum(), leaves) for x in (together, alone))
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)


def test_start_middle_and_end_of_the_clip_train_different_rows():
    planes = hexplane.HexPlane(SHAPE, torch.zeros(3), torch.ones(3), rng())
    touched = []
    for t in (0.0, 0.5, 1.0):
        planes.zero_grad()
        planes(torch.rand(40, 3, generator=rng()), t).sum().backward()
        touched.append([set(torch.nonzero(p.grad.abs().sum((0, 2, 3)))[:, 0].tolist()) for p in planes.time])
    assert touched == [[{0}] * 2, [{3}] * 2, [{6}] * 2]


def test_points_that_are_no_numbers_change_no_other():
    unit = torch.tensor([[float("nan"), 0.5, 0.5], [float("inf"), -float("inf"), 0.1], [1e30, -1e30, 0.0]])
    found = sample_levels(unit, [torch.ones(3, 4, 2)], [torch.ones(3, 4, 4, 2)])
    assert (found[1:] == 1).all(), "planes of ones, also beyond their edges"


def test_plane_tv_of_a_ramp_and_of_a_checkerboard():
    i, j = torch.meshgrid(torch.arange(8.0), torch.arange(8.0), indexing="ij")
    ramp = (2 * i + 3 * j)[None, :, :, None].repeat(3, 1, 1, 4)
    assert hexplane.plane_tv([ramp]).item() == pytest.approx(3 * (4 + 9))  # a second difference would give 0
    board = ((i + j) % 2)[None, :, :, None].repeat(3, 1, 1, 4)
    assert hexplane.plane_tv([board]).item() == pytest.approx(3 * 2)
    one, two = (hexplane.plane_tv(levels).item() for levels in ([ramp], [ramp, ramp]))
    assert one == two, "the weight does not grow with levels"


def test_time_smoothness_ignores_steady_change_and_measures_acceleration():
    t = torch.arange(9.0)[None, :, None, None]
    steady, accelerated = (5 * t).expand(3, 9, 6, 2), (t**2).expand(3, 9, 6, 2)
    assert hexplane.time_smoothness([steady]).item() == pytest.approx(0, abs=1e-9)
    assert hexplane.time_smoothness([accelerated]).item() == pytest.approx(3 * 4)


def test_gradients_of_differences_are_those_of_finite_differences():
    planes = [torch.randn(3, r, r, 2, generator=rng(r), dtype=torch.float64, requires_grad=True) for r in (5, 4)]
    for penalty in (hexplane.plane_tv, hexplane.time_smoothness):
        assert torch.autograd.gradcheck(lambda *found, f=penalty: f(found), planes)


def test_time_sparsity_is_the_distance_from_one():
    assert hexplane.time_sparsity([torch.ones(3, 4, 5, 2)]).item() == 0
    assert hexplane.time_sparsity([torch.full((3, 4, 5, 2), 0.25)]).item() == pytest.approx(3 * 0.75)


def extent(n_ticks: int, width: int) -> Extent:
    return Extent(-torch.ones(3), torch.ones(3), 1.0, n_ticks, width)


def test_resolution_follows_clip_length_and_image_size():
    s = hexplane.HexPlaneSettings()
    short, long = hexplane.hexplane_shape(extent(400, 200), s), hexplane.hexplane_shape(extent(2000, 400), s)
    assert long.times == pytest.approx(5 * short.times, rel=0.1)
    assert long.spatial[-1] == pytest.approx(2 * short.spatial[-1], rel=0.1)
    assert len(short.spatial) == s.levels and short.spatial[0] == short.spatial[1] // 2


def test_static_motion_returns_the_same_gaussians():
    g = gaussians()
    static = MOTIONS["static"](extent(100, 64), MOTIONS["static"].defaults, rng())
    assert torch.equal(static.splats(g, 0.7).means, g.means) and not static.groups() and not static.moves
