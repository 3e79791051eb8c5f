"""Guided sampling: the bad pixels, and the positions of new Gaussians."""

import numpy as np
import torch
from small_scenes import array_cameras

from spike4dgs.baselines.spacetime import BAD_PIXELS, PATCH, SpacetimeLite, along_rays, bad_pixels, guide
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.motion.base import Extent
from spike4dgs.method.splat import Splats, Views, render
from spike4dgs.method.torch_state import seeded
from spike4dgs.method.training_views.training_images import TrainingImages

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
    chosen.flat[bad_pixels(rendered, image).numpy()] = True
    expected = np.zeros_like(chosen)
    expected[32:48, 48:64] = True
    expected[8:16, 10:16] = True  # what a tenth of the image leaves of the other patch
    expected[::2, ::2] = False
    assert (chosen == expected).all()


def test_exposure_does_not_make_pixels_bad() -> None:
    rendered, image = images()
    assert torch.equal(bad_pixels(rendered * 3, image), bad_pixels(rendered, image))


def test_a_patch_needs_85_percent_of_bad_pixels() -> None:
    image = torch.ones(PATCH * 4, PATCH * 4)
    for bad, found in ((0.8, False), (0.9, True)):
        rendered = image.clone()
        rendered[PATCH : PATCH + round(bad * PATCH), PATCH : 2 * PATCH] = 2.0
        assert bool(len(bad_pixels(rendered, image))) == found
    assert BAD_PIXELS == 0.6


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
    points = along_rays(views, pixels, out, torch.Generator().manual_seed(0))
    uv, z = camera.project(points.double().numpy())
    centres = np.stack([pixels % camera.width, pixels // camera.width], -1) + 0.5
    np.testing.assert_allclose(uv, np.tile(centres, (2, 1)), atol=1e-3)
    assert (np.abs(z - 2.0) < 0.05 * 2.0 + 0.1).all() and len(set(np.round(z, 4))) == 6


def test_the_two_worst_views_ask_for_gaussians_at_their_worst_times() -> None:
    cameras = array_cameras(4, width=WIDTH, height=HEIGHT)
    extent = Extent(-torch.ones(3), torch.ones(3), 2.0, 100, WIDTH)
    motion = SpacetimeLite(extent, SpacetimeLite.defaults, seeded(0, 0))
    s = wall(cameras[0], 2.5)
    plain = Gaussians(s.means, s.scales.log(), s.quats, torch.full((len(s),), 4.0), s.colors)
    views = Views.from_cameras(cameras)
    ticks = (10, 50, 90)
    right = render(plain.splats(), views).image[..., 0]
    truth = right.expand(3, -1, -1, -1).clone()
    truth[2, 1, 32:64, 32:64] = torch.rand(32, 32, generator=torch.Generator().manual_seed(0))
    truth[0, 3, 32:48, 32:64] = torch.rand(16, 32, generator=torch.Generator().manual_seed(1))
    g = motion.timed(plain, torch.full((len(plain),), 0.5), 1e6)
    new = guide(motion, g, TrainingImages(views, ticks, truth, 100), torch.Generator().manual_seed(0))
    assert [t for _, t in new] == [0.9, 0.1]
    uv, _ = cameras[1].project(new[0][0].means.double().numpy())
    assert (uv > 32).all() and (uv < 64).all()
    more = motion.guided_samples(g, TrainingImages(views, ticks, truth, 100), torch.Generator().manual_seed(0))
    assert len(more) == len(g) + sum(len(x) for x, _ in new)
    assert torch.equal(more.means[: len(g)], g.means) and set(more.extra["times"][len(g) :].tolist()) == {
        torch.tensor(t).item() for t in (0.9, 0.1)
    }
