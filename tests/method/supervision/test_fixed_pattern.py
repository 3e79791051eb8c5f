"""The maps of `fixed-pattern` against ridge regression of all unknowns at once, and against known patterns."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_world import ToyWorld

from spike4dgs.benchmark.scene.camera_state import CameraState
from spike4dgs.method.supervision.base import Sample, difference
from spike4dgs.method.supervision.fixed_pattern import FixedPattern, FixedPatternSettings, solve
from spike4dgs.method.supervision.table import SUPERVISIONS

WORLD = ToyWorld(width=32, height=20, side=2, n_ticks=120)
WHITE = WORLD.training.radiance_gain
WHITES = torch.full((1, 1, 1), WHITE, dtype=torch.float64)  # of cameras of one gain
SETTINGS = FixedPatternSettings(first=0, every=1)
VIEWS, SIZE = len(WORLD.training.cameras), (20, 32)


def slope(height: int, width: int) -> np.ndarray:
    """A wave [H, W] of half a period down the chip, with mean 0."""
    return np.repeat(np.cos(np.pi * (np.arange(height) + 0.5) / height)[:, None], width, axis=1)


def regression(
    r: np.ndarray, i: np.ndarray, shading: np.ndarray, s: FixedPatternSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Gain and dark level [C, H, W]: least squares in float64 for gain and dark of every pixel at once."""
    light, own_dark = r.reshape(len(r), -1), s.dark_spread / WHITE
    u, n = (i - r - s.dark / WHITE - r * shading).reshape(len(r), -1), light.shape[1]
    excess = (u**2 - (s.pixel_gain * light) ** 2 - own_dark**2).reshape(r.shape)
    noise = s.model_error**2 + np.maximum(around(excess, s.noise_px // 2), 0)
    prior = 1 / np.repeat([s.pixel_gain, own_dark], n)
    columns = [np.concatenate([np.diag(a), np.eye(n)], axis=1) for a in light]
    deviation = np.sqrt(noise.reshape(len(r), -1))
    own = np.stack([ridge(x, y, e, prior) for x, y, e in zip(columns, u, deviation, strict=True)])
    gain = shading + own[:, :n].reshape(r.shape)
    return gain - gain.mean(axis=(1, 2), keepdims=True), s.dark / WHITE + own[:, n:].reshape(r.shape)


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
        ((0.2, 0.6), replace(SETTINGS, model_error=0.1, noise_px=3)),
        ((0.0, 1e-4), SETTINGS),  # the dark: nothing tells a gain
        ((0.9, 30.0), replace(SETTINGS, model_error=1e-3)),  # far brighter than white
    ],
)
def test_maps_are_those_of_ridge_regression(light: tuple[float, float], settings: FixedPatternSettings) -> None:
    rng = np.random.default_rng(0)
    r = rng.uniform(*light, (2, 7, 9))
    i = r * rng.normal(1, 0.03, r.shape) + rng.normal(0.01, 0.01, r.shape)
    i[:, 2:5, 3:6] += 0.3 * rng.random((2, 3, 3))  # what no pattern explains
    count = torch.from_numpy(rng.uniform(0.5, 20, r.shape))
    sums = torch.stack([count, count * torch.from_numpy(r), count * torch.from_numpy(i)])
    shading = 0.08 * rng.standard_normal(r.shape)
    gain, dark = solve(sums.float(), torch.from_numpy(shading).float(), settings, WHITES)
    for found, expected in zip((gain, dark), regression(r, i, shading, settings), strict=True):
        np.testing.assert_allclose(found.numpy(), expected, atol=2e-5)


def test_a_pixel_that_was_never_seen_has_the_shading_there_and_the_typical_dark_level() -> None:
    r, seen = torch.full((2, *SIZE), 0.5), torch.ones(2, *SIZE)
    seen[0, 3:6, 4:9] = 0
    shading = torch.from_numpy(np.stack([0.08 * slope(*SIZE), -0.08 * slope(*SIZE)])).float()
    i = r * (1 + shading) + SETTINGS.dark / WHITE
    gain, dark = solve(torch.stack([seen, seen * r, seen * i]), shading, SETTINGS, WHITES)
    hole = seen[0] == 0
    np.testing.assert_allclose(gain[0][hole].numpy(), shading[0][hole].numpy(), atol=1e-6)
    np.testing.assert_allclose(dark[0][hole].numpy(), SETTINGS.dark / WHITE, rtol=1e-6)


def test_the_loss_begins_with_the_shadings_of_the_scene() -> None:
    told = (1 + 0.05 * slope(*SIZE)).astype(np.float32)
    camera = WORLD.training.cameras[1].id
    scene = replace(WORLD.training, states={camera: CameraState(shading=told)})
    loss = SUPERVISIONS["fixed-pattern"](SETTINGS, scene)
    found = loss.estimates()["gain"].numpy()
    np.testing.assert_allclose(found[1], told, rtol=1e-6)
    assert (found[0] == 1).all() and (found[2:] == 1).all()


def test_a_camera_of_another_gain_has_the_same_dark_rates() -> None:
    """Images are in white: at a third of the spikes of white the dark is three times as bright in them."""
    gains = np.array([1.0, 1 / 3, 2.0])
    states = {c.id: CameraState(gain=gain) for c, gain in zip(WORLD.training.cameras, gains, strict=True)}
    loss = SUPERVISIONS["fixed-pattern"](SETTINGS, replace(WORLD.training, states=states))
    np.testing.assert_allclose(loss.estimates()["dark"].numpy(), SETTINGS.dark, rtol=1e-6)
    light, dark = torch.rand(VIEWS, *SIZE, generator=_seeded(0)), SETTINGS.dark / (WHITE * gains)
    measured = light + torch.from_numpy(dark).float()[:, None, None]
    loss(lambda t: light, Sample(0.5, 60, tuple(range(VIEWS)), measured, 0))
    np.testing.assert_allclose(loss.estimates()["dark"].numpy(), SETTINGS.dark, rtol=1e-4)
    np.testing.assert_allclose(loss.estimates()["gain"].numpy(), 1, atol=1e-5)


def loss_of(settings: FixedPatternSettings) -> FixedPattern:
    made = SUPERVISIONS["fixed-pattern"](settings, WORLD.training)
    assert isinstance(made, FixedPattern)
    return made


def normal(rng: np.random.Generator, *shape: int) -> torch.Tensor:
    return torch.from_numpy(rng.normal(size=shape)).float()


def patterns(rng: np.random.Generator, s: FixedPatternSettings) -> tuple[torch.Tensor, torch.Tensor]:
    """Gain and dark level [C, H, W] drawn from the prior."""
    gain = s.pixel_gain * normal(rng, VIEWS, *SIZE)
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
    assert float(found.std()) < 0.6 * float(gain.std())
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
