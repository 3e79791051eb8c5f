"""Spacetime Gaussians against the published formulas in float64, their edits, and the decoder."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gaussian_clouds import cloud
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp
from small_scenes import array_cameras
from torch import Tensor
from toy_fits import PARTS as TOY_PARTS
from toy_fits import WORLD as TOY
from toy_fits import surfaces
from toy_world import ToyWorld

from spike4dgs.baselines import spacetime
from spike4dgs.baselines.recipes import PARTS
from spike4dgs.benchmark.method import FitRequest, Recipe
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.gaussians.density import DensitySettings, GradientStatistics, adapt_density
from spike4dgs.method.gaussians.parameters import Gaussians, concatenate, densify, prune, relocate
from spike4dgs.method.models.fitted_model import FittedModel
from spike4dgs.method.motion.base import Extent
from spike4dgs.method.motion.polynomial import move_to
from spike4dgs.method.splat import Splats, Views, render
from spike4dgs.method.splat.reference import rotation_matrices
from spike4dgs.method.splat.types import CUSTOMARY, PixelFilter
from spike4dgs.method.torch_state import seeded
from spike4dgs.method.training_views.points import look_up, project, variation_at
from spike4dgs.method.training_views.training_images import TrainingImages

MOTIONS = PARTS.motion

WORLD = ToyWorld(width=64, height=40, side=2, n_ticks=200)
EXTENT = Extent(-torch.ones(3), torch.ones(3), 2.0, 200, 64)
SETTINGS = spacetime.SpacetimeSettings()


def motion(name: str = "spacetime") -> spacetime.SpacetimeLite:
    made = MOTIONS[name](EXTENT, MOTIONS[name].defaults, seeded(0, -1))
    assert isinstance(made, spacetime.SpacetimeLite)
    return made


@pytest.mark.parametrize("t", [0.0, 0.31, 1.0])
def test_opacity_and_path_are_the_published_ones(t: float) -> None:
    g = cloud(dtype=torch.float64)
    splats = motion().splats(g, t)
    for i in range(len(g)):
        x, m = g.means[i].numpy(), g.extra["coefficients"][i].numpy().reshape(3, 3)
        d = t - float(g.extra["times"][i])
        mean = x + m[0] * d + m[1] * d**2 + m[2] * d**3
        fade = np.exp(-((d / np.exp(float(g.extra["log_temporal_scales"][i]))) ** 2))
        np.testing.assert_allclose(splats.means[i].numpy(), mean, rtol=1e-12, atol=1e-12)
        opacity = fade / (1 + np.exp(-float(g.logits[i])))
        np.testing.assert_allclose(float(splats.opacities[i]), opacity, rtol=1e-12)
        quat = g.quats[i].numpy() + d * g.extra["angular_velocities"][i].numpy()
        R = Rotation.from_quat(quat / np.linalg.norm(quat), scalar_first=True).as_matrix()
        np.testing.assert_allclose(rotation_matrices(splats.quats[i : i + 1])[0].numpy(), R, atol=1e-12)
        np.testing.assert_allclose(splats.scales[i].numpy(), np.exp(g.log_scales[i].numpy()), rtol=1e-12)
        f = g.extra["features"][i].numpy()
        np.testing.assert_allclose(splats.colors[i].numpy(), [float(g.colors[i]), f[0], d * f[1]], rtol=1e-12)


def test_a_small_angular_velocity_turns_evenly() -> None:
    g = cloud(1, dtype=torch.float64)
    start, axis = Rotation.from_quat([0.5, 0.5, 0.5, 0.5]), np.array([0.0, 0.0, 1.0])
    end = start * Rotation.from_rotvec(0.05 * axis)
    q0, q1 = (torch.from_numpy(r.as_quat(scalar_first=True)) for r in (start, end))
    g = replace(g, quats=q0[None], extra={**g.extra, "times": torch.zeros(1), "angular_velocities": (q1 - q0)[None]})
    halfway = rotation_matrices(motion().splats(g, 0.5).quats)[0].numpy()
    expected = Slerp([0, 1], Rotation.concatenate([start, end]))(0.5).as_matrix()
    np.testing.assert_allclose(halfway, expected, atol=1e-6)


def test_times_learn_from_opacity_alone_and_lite_splats_gray() -> None:
    g = cloud(dtype=torch.float64).trainable()
    splats = motion().splats(g, 0.4)
    for part in (splats.means, splats.quats, splats.colors):
        grad = torch.autograd.grad(part.square().sum(), g.extra["times"], allow_unused=True, retain_graph=True)[0]
        assert grad is None or not grad.any()
    (grad,) = torch.autograd.grad(splats.opacities.sum(), g.extra["times"])
    assert grad.abs().min() > 0
    assert torch.equal(motion("spacetime-lite").splats(g, 0.4).colors, g.colors)


def test_a_faded_gaussian_is_not_rasterised() -> None:
    g = cloud(20)
    g.means.mul_(0.2)
    g.logits[:] = 5.0
    g.extra["times"][:10], g.extra["log_temporal_scales"][:] = 0.9, -2.5
    g.extra["times"][10:], g.extra["coefficients"][:] = 0.2, 0.0
    out = render(motion("spacetime-lite").splats(g, 0.2), Views.from_cameras(array_cameras(1)))
    assert not out.visible[0, :10].any() and out.visible[0, 10:].all()


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31), st.floats(0, 1))
def test_a_path_is_the_same_around_any_time(seed: int, t: float) -> None:
    g = cloud(seed=seed, dtype=torch.float64)
    moved = move_to(g, torch.rand(len(g), generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64))
    before, after = motion().splats(g, t), motion().splats(moved, t)
    torch.testing.assert_close(after.means, before.means, rtol=0, atol=1e-10)
    torch.testing.assert_close(after.quats, before.quats, rtol=0, atol=1e-10)


EDITS = ("prune", "densify", "relocate", "concatenate")


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.lists(st.sampled_from(EDITS), min_size=1, max_size=5))
def test_extra_parameters_stay_with_their_gaussians_through_all_edits(seed: int, edits: list[str]) -> None:
    rng = torch.Generator().manual_seed(seed)
    g = cloud(10, seed)
    ids = torch.arange(10.0)
    g = replace(g, colors=ids[:, None], extra={"a": ids, "b": ids[:, None].repeat(1, 3)})
    for name in edits:
        mask, other = torch.rand(2, len(g), generator=rng) < 0.4
        if name == "prune":
            g = prune(g, mask | (torch.arange(len(g)) == 0)).gaussians
        elif name == "densify":
            edit = densify(g, mask, other, rng)
            assert (
                edit.added == int((edit.source < 0).sum()) and (edit.source[len(edit.source) - edit.added :] < 0).all()
            )
            g = edit.gaussians
        elif name == "relocate":
            g = relocate(g, mask, rng).gaussians
        else:
            g = concatenate([g, g.rows(mask)])
        assert torch.equal(g.extra["a"], g.colors[:, 0]) and torch.equal(g.extra["b"], g.colors.repeat(1, 3))


def test_what_densification_adds_gets_random_times_and_keeps_to_its_path() -> None:
    g = cloud(12)
    g.logits[:] = 0.0
    statistics = GradientStatistics(torch.tensor([1.0, 0.0] * 6), torch.ones(12))
    (edit,) = adapt_density(g, statistics, DensitySettings(), 100.0, 50, torch.Generator().manual_seed(0))
    born = motion().after_densification(edit, torch.Generator().manual_seed(1))
    old, new = born.gaussians.rows(torch.arange(12)), born.gaussians.rows(torch.arange(12, 18))
    assert edit.added == born.added == 6 and all(torch.equal(v, g.tensors()[k]) for k, v in old.tensors().items())
    assert new.extra["times"].min() >= 0 and new.extra["times"].max() <= 1 and new.extra["times"].std() > 0.1
    before, after = (motion().splats(x, 0.7) for x in (g.rows(torch.arange(0, 12, 2)), new))
    torch.testing.assert_close(after.means, before.means, rtol=0, atol=1e-5)


def test_relocated_gaussians_keep_their_hosts_times() -> None:
    g = cloud(12)
    edit = relocate(g, torch.arange(12) < 3, torch.Generator().manual_seed(0))
    assert torch.equal(
        motion().after_densification(edit, torch.Generator()).gaussians.extra["times"], edit.gaussians.extra["times"]
    )


@pytest.mark.parametrize("lens", [(), (-0.3, 0.05, 0.01, -0.02, 0.0)])
def test_rays_project_to_their_pixels(lens: tuple[float, ...]) -> None:
    first, second = array_cameras(2)
    cameras = [first, replace(second, distortion=lens)]
    origin, direction = spacetime.rays(Views.from_cameras(cameras))
    for i, camera in enumerate(cameras):
        np.testing.assert_allclose(origin[i].numpy(), camera.center, atol=1e-12)
        d = direction[i].double().numpy().T
        np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, rtol=1e-6)
        uv, z = camera.project(camera.center + 2.5 * d)
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        np.testing.assert_allclose(uv, np.stack([u, v], -1).reshape(-1, 2), atol=1e-4)
        assert (z > 0).all()


def test_decoder_is_two_pointwise_layers_beside_the_albedo() -> None:
    cameras = array_cameras(2)
    views = Views.from_cameras(cameras)
    center = torch.tensor([0.1, -0.2, 0.3])
    decoder = spacetime.Decoder(center, 1.7, torch.Generator().manual_seed(0))
    channels = torch.rand(2, views.height, views.width, 3, generator=torch.Generator().manual_seed(1))
    assert torch.equal(decoder(channels, views), channels[..., 0])  # it starts as the albedo
    with torch.no_grad():
        decoder.second.copy_(torch.randn(1, 6, generator=torch.Generator().manual_seed(2)))
    w1, w2 = (p.detach().double().numpy() for p in (decoder.first, decoder.second))
    out = decoder(channels, views).detach().numpy()
    for view, v, u in ((0, 0, 0), (1, 7, 31), (1, 23, 39)):
        camera = cameras[view]
        point = camera.unproject(np.array([[u + 0.5, v + 0.5]]), np.array([1.0]))[0]
        ray = (point - camera.center) / np.linalg.norm(point - camera.center)
        albedo, *features = channels[view, v, u].double().numpy()
        x = np.concatenate([features, (camera.center - center.double().numpy()) / 1.7, ray])
        np.testing.assert_allclose(out[view, v, u], albedo + w2[0] @ np.maximum(w1 @ x, 0), rtol=1e-4, atol=1e-5)


def make_training_images(count: int = 9) -> TrainingImages:
    ticks = tuple(int(t) for t in np.linspace(0, WORLD.n_ticks - 1, count))
    frames = [[WORLD.trace(c, t / WORLD.n_ticks)[0] for c in WORLD.cameras] for t in ticks]
    images = torch.from_numpy(np.array(frames, np.float32))
    return TrainingImages(Views.from_cameras(WORLD.cameras), ticks, images, WORLD.n_ticks)


def surface() -> tuple[Tensor, np.ndarray]:
    """Points of one view's surfaces at the clip's middle, and which lie on the board that moves."""
    camera = WORLD.cameras[0]
    _, depth, board = WORLD.trace(camera, 0.5)
    v, u = np.mgrid[4 : camera.height - 4 : 3, 4 : camera.width - 4 : 3].reshape(2, -1)
    points = camera.unproject(np.stack([u, v], -1) + 0.5, depth[v, u])
    return torch.from_numpy(points.astype(np.float32)), board[v, u]


def test_only_what_moves_is_laid_down_several_times_with_the_values_of_its_times() -> None:
    points, board = surface()
    f = make_training_images()
    change = variation_at(points, f).numpy()
    shift = change > SETTINGS.moving_change
    assert shift[board].mean() > 0.5 > 3 * shift[~board].mean()  # the board uncovers some of what is behind it
    n = len(points)
    g = Gaussians(points, torch.zeros(n, 3), torch.ones(n, 4), torch.zeros(n), torch.zeros(n, 1))
    timed = motion().initialize(g, f)
    short = timed.extra["log_temporal_scales"].exp() < 1
    assert len(timed) == n + (SETTINGS.moving_copies - 1) * shift.sum() and int(short.sum()) == 3 * shift.sum()
    thirds = (timed.extra["times"][short].view(3, -1) * 3).long()
    assert torch.equal(thirds, torch.arange(3)[:, None].expand_as(thirds))
    assert not timed.extra["coefficients"].any() and not timed.extra["angular_velocities"].any()
    assert torch.equal(timed.extra["features"][:, 0], timed.colors[:, 0])
    i = int(torch.nonzero(short)[0])
    t = timed.extra["times"][i : i + 1]
    nearest = int(np.abs(np.array(f.ticks) / f.n_ticks - float(t)).argmin())
    seen = [p.flatten()[r[i_]] for p, r, i_ in zip(f.images[nearest], *_at(timed.means[i : i + 1], f), strict=True)]
    assert timed.colors[i, 0] in seen
    assert torch.equal(look_up(timed.means[i : i + 1], t, f), timed.colors[i])


def _at(point: Tensor, f: TrainingImages) -> tuple[Tensor, list[int]]:
    return project(point, f.views)[0], [0] * len(f.views)


def test_groups_and_learning_rates_name_every_parameter() -> None:
    full, lite = motion(), motion("spacetime-lite")
    g = full.timed(cloud(4), torch.zeros(4), 1.0)
    assert set(full.learning_rates()) == set(g.extra) and set(lite.learning_rates()) == set(g.extra) - {"features"}
    assert isinstance(full, spacetime.Spacetime) and set(full.groups()) == {"decoder"} and not lite.groups()
    assert full.groups()["decoder"][0] == list(full.decoder.parameters())


HEIGHT, WIDTH = 80, 96


def images() -> tuple[torch.Tensor, torch.Tensor]:
    """A render that is right but for two patches, one of them at the border."""
    rng = torch.Generator().manual_seed(0)
    image = 0.5 + 0.01 * torch.rand(HEIGHT, WIDTH, generator=rng)
    rendered = image + 0.001 * torch.rand(HEIGHT, WIDTH, generator=rng)
    rendered[32:48, 48:64] += 0.3
    rendered[0:16, 0:16] += 0.3
    return rendered, image


def test_pixels_of_bad_patches_are_sampled_and_the_border_is_not() -> None:
    rendered, image = images()
    chosen = np.zeros((HEIGHT, WIDTH), bool)
    chosen.flat[spacetime.bad_pixels(rendered, image).numpy()] = True
    expected = np.zeros_like(chosen)
    expected[32:48, 48:64] = True
    expected[8:16, 10:16] = True  # what a tenth of the image leaves of the other patch
    expected[::2, ::2] = False
    assert (chosen == expected).all()


def test_exposure_does_not_make_pixels_bad() -> None:
    rendered, image = images()
    assert torch.equal(spacetime.bad_pixels(rendered * 3, image), spacetime.bad_pixels(rendered, image))


def test_a_patch_needs_85_percent_of_bad_pixels() -> None:
    side = spacetime.PATCH
    image = torch.ones(side * 4, side * 4)
    for bad, found in ((0.8, False), (0.9, True)):
        rendered = image.clone()
        rendered[side : side + round(bad * side), side : 2 * side] = 2.0
        assert bool(len(spacetime.bad_pixels(rendered, image))) == found
    assert spacetime.BAD_PIXELS == 0.6


def test_a_view_smaller_than_a_patch_has_no_bad_pixels() -> None:
    for height, width in ((12, 64), (64, 12)):
        assert spacetime.bad_pixels(torch.ones(height, width).cumsum(0), torch.ones(height, width)).shape == (0,)


def wall(camera: Camera, distance: float) -> Splats:
    """Opaque Gaussians of random gray in a plane across a camera's view and beyond."""
    margin = camera.width // 4
    v, u = np.mgrid[-margin : camera.height + margin : 2, -margin : camera.width + margin : 2].reshape(2, -1)
    points = torch.from_numpy(camera.unproject(np.stack([u, v], -1) + 0.5, np.full(u.size, distance))).float()
    n, quats = len(points), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    gray = torch.rand(n, 1, generator=torch.Generator().manual_seed(3))
    return Splats(points, quats.repeat(n, 1), torch.full((n, 3), 0.05), torch.full((n,), 0.99), gray)


def test_points_lie_on_their_pixels_rays_at_the_depths_that_the_view_shows() -> None:
    camera = array_cameras(1)[0]
    views = Views.from_cameras([camera])
    out = render(wall(camera, 2.0), views, depth=True)
    pixels = torch.tensor([100, 333, 517])
    points = spacetime.along_rays(views, pixels, out, torch.Generator().manual_seed(0))
    uv, z = camera.project(points.double().numpy())
    centres = np.stack([pixels % camera.width, pixels // camera.width], -1) + 0.5
    np.testing.assert_allclose(uv, np.tile(centres, (2, 1)), atol=1e-3)
    assert (np.abs(z - 2.0) < 0.05 * 2.0 + 0.1).all() and len(set(np.round(z, 4))) == 6


def lite() -> spacetime.SpacetimeLite:
    extent = Extent(-torch.ones(3), torch.ones(3), 2.0, 100, WIDTH)
    return spacetime.SpacetimeLite(extent, spacetime.SpacetimeLite.defaults, seeded(0, 0))


def test_a_model_that_equals_its_images_has_no_bad_pixels_by_the_filter_of_the_fit() -> None:
    """By another one its edges look wrong."""
    camera = array_cameras(2, width=WIDTH, height=HEIGHT)
    motion = lite()
    s = wall(camera[0], 2.5)
    thin = Gaussians(s.means, (s.scales * 0.3).log(), s.quats, torch.full((len(s),), 4.0), s.colors)
    g, views = motion.timed(thin, torch.full((len(thin),), 0.5), 1e6), Views.from_cameras(camera)
    sharp = PixelFilter(1 / 12, True)
    truth = render(motion.splats(g, 0.5), views, sharp).image[..., 0]
    images = TrainingImages(views, (50,), truth[None], 100)
    errors = []
    for motion.pixel_filter in (sharp, CUSTOMARY):
        _, image = spacetime._render(motion, g, images, 1, 0.5)
        errors.append(float((image - truth[1]).abs().max()))
    assert errors[0] == 0 < errors[1]


def test_the_two_worst_views_ask_for_gaussians_at_their_worst_times() -> None:
    cameras = array_cameras(4, width=WIDTH, height=HEIGHT)
    motion = lite()
    s = wall(cameras[0], 2.5)
    plain = Gaussians(s.means, s.scales.log(), s.quats, torch.full((len(s),), 4.0), s.colors)
    views, ticks = Views.from_cameras(cameras), (10, 50, 90)
    right = render(plain.splats(), views).image[..., 0]
    truth = right.expand(3, -1, -1, -1).clone()
    truth[2, 1, 32:64, 32:64] = torch.rand(32, 32, generator=torch.Generator().manual_seed(0))
    truth[0, 3, 32:48, 32:64] = torch.rand(16, 32, generator=torch.Generator().manual_seed(1))
    g = motion.timed(plain, torch.full((len(plain),), 0.5), 1e6)
    images = TrainingImages(views, ticks, truth, 100)
    new = spacetime.guide(motion, g, images, torch.Generator().manual_seed(0))
    assert [t for _, t in new] == [0.9, 0.1]
    uv, _ = cameras[1].project(new[0][0].means.double().numpy())
    assert (uv > 32).all() and (uv < 64).all()
    more = motion.guided_samples(g, images, torch.Generator().manual_seed(0))
    assert len(more) == len(g) + sum(len(x) for x, _ in new)
    lamp = replace(g, colors=torch.cat([g.colors, torch.ones_like(g.colors)], dim=1))
    beside = motion.guided_samples(lamp, images, torch.Generator().manual_seed(0))
    assert beside.colors.shape[1] == 2 and not beside.colors[len(g) :, 1].any(), "new ones have no share of a lamp yet"
    missing = torch.zeros(3, 4, dtype=torch.bool)
    missing[2, 1] = True
    new = spacetime.guide(motion, g, replace(images, missing=missing), torch.Generator().manual_seed(0))
    assert [t for _, t in new] == [0.1], "nothing was measured"
    assert torch.equal(more.means[: len(g)], g.means)
    assert set(more.extra["times"][len(g) :].tolist()) == set(torch.tensor([0.9, 0.1]).tolist())


@pytest.mark.parametrize(("name", "copies"), [("hexplane", 1), ("spacetime", 3)])
def test_a_cap_leaves_as_much_room_where_points_are_laid_down_at_several_times(name: str, copies: int) -> None:
    points = len(surfaces(TOY.training, 0).points)
    own = {
        "images.time_spacing_ticks": 40,
        "trainer.coarse_steps": 4,
        "trainer.fine_steps": 16,
        "density.refine_every": 2,
        "density.grow_grad2d": 0.0,
        "density.max_per_pixel": 1.2 * points / (TOY.width * TOY.height),
    }
    if copies > 1:  # all points move
        own |= {"motion.moving_change": -1.0, "motion.moving_copies": copies, "motion.guided_rounds": 0}
    model = RecipeMethod(Recipe("test", "short", "true", name, "pixel", own), TOY_PARTS).fit(TOY.training, FitRequest())
    assert isinstance(model, FittedModel)
    assert 1.1 * copies * points < len(model.pieces[0]) <= 1.21 * copies * points
