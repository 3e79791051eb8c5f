"""The detector of changes: its variation against numpy, and the limits of its users."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_world import ToyWorld

from spike4dgs.method.splat import Views
from spike4dgs.method.training_views import changes
from spike4dgs.method.training_views.points import project


def averaged(images: torch.Tensor, s: changes.ChangeSettings) -> np.ndarray:
    """Images blurred plainly, one shift of the window after another."""
    reach, found = s.blur_px // 2, images.double().numpy()
    height, width = found.shape[2:]
    shifts = [(y, x) for y in range(s.blur_px) for x in range(s.blur_px)]

    def summed(values: np.ndarray) -> np.ndarray:
        padded = np.pad(values, ((0, 0), (0, 0), (reach, reach), (reach, reach)))
        return np.sum([padded[..., y : y + height, x : x + width] for y, x in shifts], axis=0)

    return summed(found) / (s.blur_px**2 if s.zeros_outside else summed(np.ones_like(found)))


@pytest.mark.parametrize("s", [changes.POINTS, changes.MASKS, changes.RAYS])
def test_variation_is_the_deviation_of_blurred_images(s: changes.ChangeSettings) -> None:
    images = torch.rand(5, 2, 8, 9, generator=torch.Generator().manual_seed(1))
    tolerance = 1e-12 if s.float64 else 1e-6
    np.testing.assert_allclose(changes.variation(images, s), averaged(images, s).std(axis=0), atol=tolerance)


def test_a_pixel_changes_above_the_limit() -> None:
    images = torch.zeros(2, 1, 1, 3)
    images[1, 0, 0] = torch.tensor([0.079, 0.081, 0.5])
    assert changes.changing(images, changes.RAYS).tolist() == [[[False, True, True]]]


def test_counts_of_constant_radiance_do_not_change() -> None:
    counts = torch.full((4, 1, 2, 2), 20)
    counts[1, 0, 0] += torch.tensor([1, 2])
    counts[2, 0, 1] += torch.tensor([-2, 3])
    assert changes.changing(counts, changes.COUNTS).tolist() == [[[False, False], [False, True]]]


def test_the_limit_of_masks_follows_the_noise_within_its_bounds() -> None:
    g = torch.Generator().manual_seed(0)
    for noise, limit in ((1e-4, 0.01), (0.015, None), (0.3, 0.05)):
        images = 0.5 + noise * torch.randn(30, 1, 40, 50, generator=g)
        found = changes.variation(images, changes.MASKS)
        expected = limit or changes.MASKS.noise_factor * float(np.quantile(found, changes.MASKS.noise_share))
        assert 0.01 <= expected <= 0.05
        assert torch.equal(changes.changing(images, changes.MASKS), found > expected)


def test_single_pixels_are_specks() -> None:
    mask = np.zeros((9, 9), bool)
    mask[2, 2] = mask[4:8, 4:8] = True
    cleaned = changes.without_specks(mask)
    assert not cleaned[:4, :4].any() and cleaned[5:7, 5:7].all()


WORLD = ToyWorld(width=64, height=40)


@pytest.mark.parametrize("lens", [(), (-0.4, 0.0, 0.01, -0.02, 0.0)])
@pytest.mark.filterwarnings("ignore:invalid value encountered in cast")
def test_pixels_are_those_of_the_cameras(lens: tuple[float, ...]) -> None:
    points = np.random.default_rng(0).normal(0, 2, (400, 3))
    cameras = [WORLD.cameras[0], *(replace(c, distortion=lens) for c in WORLD.cameras[1:])]
    pixels, inside = project(torch.from_numpy(points), Views.from_cameras(cameras))
    assert inside.any() and not inside.all()
    for camera, pixel, seen in zip(cameras, pixels.numpy(), inside.numpy(), strict=True):
        uv, z = camera.project(points)
        expected = (z > 0) & (uv >= 0).all(1) & (uv < [camera.width, camera.height]).all(1)
        u, v = uv[expected].astype(int).T
        assert np.array_equal(seen, expected)
        assert np.array_equal(pixel[seen], v * camera.width + u) and not pixel[~seen].any()


def test_the_wider_dtype_counts() -> None:
    """1 mm at 1e4 m is less than float32 resolves."""
    away, views = torch.tensor([7e3, -5e3, 6e3], dtype=torch.float64), Views.from_cameras(WORLD.cameras)
    w2c = views.w2c.clone()
    w2c[:, :3, 3] -= w2c[:, :3, :3] @ away
    points = torch.from_numpy(np.random.default_rng(1).normal(0, 0.3, (200, 3)))
    far = project(points + away, Views(w2c, views.K, views.width, views.height))
    assert all(torch.equal(a, b) for a, b in zip(far, project(points, views), strict=True))
