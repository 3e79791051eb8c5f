"""Rays of lenses and of blurred pixels, which only the variants that compile kernels have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from built_worlds import built as world
from scipy.ndimage import gaussian_filter
from scipy.stats import norm

from spike4dgs.generators.rendering.mitsuba_variant import load_mitsuba
from spike4dgs.generators.rendering.render import MultiViewRenderer
from spike4dgs.generators.rig import cameras


@pytest.fixture(scope="module")
def wavefront():
    if load_mitsuba().variant().startswith("scalar"):
        pytest.skip("the scalar variant has no lenses and no blur")
    from spike4dgs.generators.rendering import wavefront

    return wavefront


@pytest.mark.parametrize("sigma", [0.2, 0.5, 0.8])
def test_a_blurred_pixels_footprint_is_a_box_and_a_gaussian(wavefront, sigma):
    x = wavefront.footprint_quantiles(sigma)
    assert x == pytest.approx(-x[::-1], abs=1e-6) and (np.diff(x) > 0).all()
    middle = (x[1:] + x[:-1]) / 2
    assert np.mean(middle**2) == pytest.approx(1 / 12 + sigma**2, rel=2e-3)
    inside = np.random.default_rng(0).uniform(-0.5, 0.5, 400_000)
    for edge in (-0.7, 0.0, 0.4, 1.1):  # the response to an edge, by another way
        assert np.mean(middle < edge) == pytest.approx(norm.cdf((edge - inside) / sigma).mean(), abs=2e-3)


def test_a_blur_of_a_number_that_rounded_to_one_is_the_last_quantile(wavefront):
    views = wavefront.Views.of(cameras(world("car"), 8, 5, (4,)), 0.5)
    assert np.array(views._blurred(wavefront.mi.Float(1.0)))[0] == pytest.approx(
        0.5 + wavefront.footprint_quantiles(0.5)[-1]
    )


def test_a_blur_is_that_of_the_radiance_and_keeps_its_sum(wavefront):
    """Against a rendering with four times the pixels along each side, filtered by SciPy."""
    sigma, fine, width, height = 0.6, 4, 32, 20
    w = world("turntable")

    def whole(scale, spp, **options):
        rig = cameras(w, width * scale, height * scale, (4,))
        return MultiViewRenderer(w, rig, seed=0, spp=spp, background_spp=spp, **options).crn_frames(0.0)[0]

    blurred, large = whole(1, 512, psf_px=sigma).astype(np.float64), whole(fine, 64).astype(np.float64)
    sharp, expected = (
        image.reshape(height, fine, width, fine).mean((1, 3))
        for image in (large, gaussian_filter(large, sigma * fine, mode="nearest"))
    )
    inside = np.s_[3:-3, 3:-3]  # beyond the image's edge only the renderer sees
    assert np.abs(sharp - expected)[inside].mean() > 0.01
    assert np.abs(blurred - expected)[inside].mean() < 0.004  # the noise of both
    assert blurred[inside].mean() == pytest.approx(expected[inside].mean(), rel=2e-3)


def test_rays_go_through_the_lens(wavefront):
    mi = wavefront.mi
    lens = (-0.25, 0.05, 0.002, -0.003, 0.01)
    rig = [cameras(world("car"), 64, 40, (4,))[0], replace(cameras(world("car"), 64, 40, (0,))[0], distortion=lens)]
    renderer = MultiViewRenderer(world("car"), rig, seed=0, spp=1, background_spp=1)
    v, u = np.mgrid[:40:3, :64:3].reshape(2, -1) + 0.5
    for view, camera in enumerate(rig):
        ray = renderer._tracer._views._ray(mi.UInt32(np.full(len(u), view)), mi.Float(u), mi.Float(v))
        points = camera.unproject(np.stack([u, v], 1), np.ones(len(u))) - camera.center
        expected = points / np.linalg.norm(points, axis=1, keepdims=True)
        assert np.abs(np.array(ray.d).T - expected).max() < 1e-6
