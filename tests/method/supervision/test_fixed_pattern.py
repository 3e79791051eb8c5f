"""The maps of `fixed-pattern` against ridge regression of all unknowns at once, and against known patterns."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_world import ToyWorld

from spike4dgs.method.supervision.base import Sample, difference
from spike4dgs.method.supervision.fixed_pattern import FixedPattern, FixedPatternSettings, shading_basis, solve
from spike4dgs.method.supervision.table import SUPERVISIONS

WORLD = ToyWorld(width=32, height=20, side=2, n_ticks=120)
WHITE = WORLD.training.radiance_gain
SETTINGS = FixedPatternSettings(first=0, every=1)
VIEWS, SIZE = len(WORLD.training.cameras), (20, 32)


def cosines(height: int, width: int, order: int) -> np.ndarray:
    """Cosines [H, W, M], one at a time."""
    y, x = np.mgrid[:height, :width]
    pairs = [(i, j) for i in range(order + 1) for j in range(order + 1) if 0 < i + j <= order]
    waves = [np.cos(i * np.pi * (y + 0.5) / height) * np.cos(j * np.pi * (x + 0.5) / width) for i, j in pairs]
    return np.stack(waves, axis=-1) if waves else np.zeros((height, width, 0))


def regression(r: np.ndarray, i: np.ndarray, s: FixedPatternSettings) -> tuple[np.ndarray, np.ndarray]:
    """Gain and dark level [C, H, W]: least squares in float64 for the shading, gain and dark of every pixel at once.

    The shadings' mean is taken away, and gain and dark are found once more; then all that with the noise around pixels.
    """
    light, left = r.reshape(len(r), -1), (i - r - s.dark / WHITE).reshape(len(r), -1)
    basis = cosines(*r.shape[1:], s.shading_order).reshape(light.shape[1], -1)
    (n, m), own_dark = basis.shape, s.dark_spread / WHITE
    spread = s.shading / np.sqrt((basis**2).mean(axis=0).sum()) if m else 1.0
    noise = np.full(r.shape, s.model_error**2)
    for _ in range(2):
        deviation = np.sqrt(noise.reshape(len(r), -1))
        columns = [np.concatenate([a[:, None] * basis, np.diag(a), np.eye(n)], axis=1) for a in light]
        prior = 1 / np.repeat([spread, s.pixel_gain, own_dark], [m, n, n])
        waves = np.stack([ridge(x, y, e, prior)[:m] for x, y, e in zip(columns, left, deviation, strict=True)])
        shading = (waves - waves.mean(axis=0)) @ basis.T
        u = left - light * shading
        own = np.stack([ridge(x[:, m:], y, e, prior[m:]) for x, y, e in zip(columns, u, deviation, strict=True)])
        excess = (u**2 - (s.pixel_gain * light) ** 2 - own_dark**2).reshape(r.shape)
        noise = s.model_error**2 + np.maximum(around(excess, s.noise_px // 2), 0)
    gain = shading + own[:, :n]
    return (gain - gain.mean(axis=1, keepdims=True)).reshape(r.shape), s.dark / WHITE + own[:, n:].reshape(r.shape)


def ridge(columns: np.ndarray, values: np.ndarray, deviation: np.ndarray, prior: np.ndarray) -> np.ndarray:
    data = np.concatenate([columns / deviation[:, None], np.diag(prior)])
    return np.linalg.lstsq(data, np.concatenate([values / deviation, np.zeros(len(prior))]), rcond=None)[0]


def around(images: np.ndarray, reach: int) -> np.ndarray:
    """Means [C, H, W] over squares, of what of them is in the image."""
    out = np.empty_like(images)
    for c, y, x in np.ndindex(images.shape):
        top, left = max(0, y - reach), max(0, x - reach)
        out[c, y, x] = images[c, top : y + reach + 1, left : x + reach + 1].mean()
    return out


@pytest.mark.parametrize(
    "light, settings",
    [
        ((0.0, 1.0), SETTINGS),
        ((0.2, 0.6), replace(SETTINGS, shading_order=1, model_error=0.1, noise_px=3)),
        ((0.0, 1e-4), SETTINGS),  # the dark: nothing tells a gain
        ((0.9, 30.0), replace(SETTINGS, shading_order=0, model_error=1e-3)),  # far brighter than white
    ],
)
def test_maps_are_those_of_ridge_regression(light: tuple[float, float], settings: FixedPatternSettings) -> None:
    rng = np.random.default_rng(0)
    r = rng.uniform(*light, (2, 7, 9))
    i = r * rng.normal(1, 0.03, r.shape) + rng.normal(0.01, 0.01, r.shape)
    i[:, 2:5, 3:6] += 0.3 * rng.random((2, 3, 3))  # what no pattern explains
    count = torch.from_numpy(rng.uniform(0.5, 20, r.shape))
    sums = torch.stack([count, count * torch.from_numpy(r), count * torch.from_numpy(i)])
    gain, dark = solve(sums.float(), settings, WHITE)
    for found, expected in zip((gain, dark), regression(r, i, settings), strict=True):
        np.testing.assert_allclose(found.numpy(), expected, atol=2e-5)


def test_a_pixel_that_was_never_seen_has_the_shading_around_it_and_the_typical_dark_level() -> None:
    r, seen = torch.full((2, *SIZE), 0.5), torch.ones(2, *SIZE)
    seen[0, 3:6, 4:9] = 0
    slope = cosines(*SIZE, 1)[..., 0] * 0.08
    i = r * (1 + torch.from_numpy(np.stack([slope, -slope])).float()) + SETTINGS.dark / WHITE
    gain, dark = solve(torch.stack([seen, seen * r, seen * i]), SETTINGS, WHITE)
    hole = seen[0] == 0
    np.testing.assert_allclose(gain[0][hole].numpy(), slope[hole.numpy()], atol=2e-3)
    np.testing.assert_allclose(dark[0][hole].numpy(), SETTINGS.dark / WHITE, rtol=1e-6)


def test_a_shading_that_all_cameras_share_is_left_to_the_scene() -> None:
    r = torch.full((3, *SIZE), 0.5)
    shared, own = 0.08 * cosines(*SIZE, 1)[..., 1], 0.04 * cosines(*SIZE, 1)[..., 0]
    true = np.stack([shared + own, shared - own, shared])
    i = r * (1 + torch.from_numpy(true).float()) + SETTINGS.dark / WHITE
    gain, _ = solve(torch.stack([torch.ones_like(r), r, i]), replace(SETTINGS, pixel_gain=1e-6), WHITE)
    np.testing.assert_allclose(gain.numpy(), true - shared, atol=2e-3)


def loss_of(settings: FixedPatternSettings) -> FixedPattern:
    made = SUPERVISIONS["fixed-pattern"](settings, WORLD.training)
    assert isinstance(made, FixedPattern)
    return made


def normal(rng: np.random.Generator, *shape: int) -> torch.Tensor:
    return torch.from_numpy(rng.normal(size=shape)).float()


def patterns(rng: np.random.Generator, s: FixedPatternSettings) -> tuple[torch.Tensor, torch.Tensor]:
    """Gain and dark level [C, H, W] drawn from the prior; the cameras' shadings have the mean 0."""
    basis, spread = shading_basis(*SIZE, s, torch.device("cpu"))
    waves = normal(rng, VIEWS, len(basis)) * spread
    gain = ((waves - waves.mean(0)) @ basis).reshape(VIEWS, *SIZE) + s.pixel_gain * normal(rng, VIEWS, *SIZE)
    dark = (s.dark + s.dark_spread * normal(rng, VIEWS, *SIZE)) / WHITE
    return gain - gain.mean((1, 2), keepdim=True), dark


def test_known_patterns_are_found_from_noisy_images_of_a_changing_scene() -> None:
    """The error of the gain is hardly more than the prior leaves in light r: (1/σ_l² + r²/(σ_d² + σ_n²))^(-1/2)."""
    noise, memory = 0.02, 200
    s = replace(
        SETTINGS, model_error=noise / 128**0.5, memory=memory, every=20
    )  # 133 steps see a pixel, as good as 128
    rng = np.random.default_rng(1)
    gain, dark = patterns(rng, s)
    loss = loss_of(s)
    for step in range(200):
        views = tuple(sorted(rng.choice(VIEWS, 2, replace=False).tolist()))
        light = torch.from_numpy(rng.uniform(0.6, 0.8, (2, *SIZE))).float()
        chosen = list(views)
        measured = light * (1 + gain[chosen]) + dark[chosen] + noise * torch.randn(light.shape, generator=_seeded(step))
        loss(lambda t, x=light: x, Sample(0.5, 60, views, measured, step))
    found, expected = (
        loss.gain - gain,
        (s.pixel_gain**-2 + 0.7**2 / ((s.dark_spread / WHITE) ** 2 + s.model_error**2)) ** -0.5,
    )
    assert expected < float(found.std()) < 1.4 * expected  # the noise is measured, from 49 pixels
    assert float(found.std()) < 0.3 * float(gain.std())
    assert float((loss.dark - dark).std()) < float(dark.std())


def _seeded(step: int) -> torch.Generator:
    return torch.Generator().manual_seed(step)


@pytest.mark.parametrize("delta", [0.0, 0.05])
def test_the_loss_compares_through_the_maps_and_leaves_other_views_alone(delta: float) -> None:
    loss = loss_of(replace(SETTINGS, first=1000, ssim_weight=0.3, huber_delta=delta))
    loss.gain[1], loss.dark[1] = 0.25, 0.02
    image = torch.rand(1, *SIZE, generator=_seeded(0)).requires_grad_()
    measured = torch.rand(1, *SIZE, generator=_seeded(1))
    measured[0, 2, 3] = torch.nan
    value = loss(lambda t: image, Sample(0.5, 60, (1,), measured, 0))
    expected = difference(image * 1.25 + 0.02, measured, 0.3, delta)
    assert value.item() == pytest.approx(expected.item(), rel=1e-6)
    np.testing.assert_array_equal(
        *(torch.autograd.grad(v, image, retain_graph=True)[0].numpy() for v in (value, expected))
    )
    assert loss.sums[0, 1].sum() == 20 * 32 - 1 and not loss.sums[:, [0, 2]].any()


def test_older_steps_weigh_less_and_an_unmeasured_pixel_forgets_nothing() -> None:
    loss = loss_of(replace(SETTINGS, first=1000, memory=5))
    images = torch.rand(4, 1, *SIZE, generator=_seeded(2))
    images[3, 0, 0, 0] = torch.nan
    for step, image in enumerate(images):
        loss(lambda t, x=image: 2 * x.nan_to_num(), Sample(0.5, 60, (0,), image, step))
    weights = np.exp(-np.arange(3, -1, -1) / 5)
    np.testing.assert_allclose(loss.sums[0, 0, 1, 1], weights.sum(), rtol=1e-6)
    np.testing.assert_allclose(loss.sums[2, 0, 1, 1], (weights * images[:, 0, 1, 1].numpy()).sum(), rtol=1e-6)
    np.testing.assert_allclose(loss.sums[1, 0, 0, 0], 2 * (weights[1:] * images[:3, 0, 0, 0].numpy()).sum(), rtol=1e-6)
