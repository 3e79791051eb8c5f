"""The coat in closed form against Mitsuba's `roughplastic`, and against what light has to do."""

import numpy as np
import pytest

from spike4dgs.generators.rendering.mitsuba_variant import load_mitsuba
from spike4dgs.studies.second_renderer.coat import IOR, coat, crossing, fresnel

ALBEDO = 0.8


def mitsuba_matte(alpha: float, view: float, light: float) -> float:
    """Return pi f of the matte lobe over the albedo, by the cosines of view and light."""
    mi = load_mitsuba()
    bsdf = mi.load_dict(
        {"type": "roughplastic", "alpha": alpha, "diffuse_reflectance": {"type": "rgb", "value": ALBEDO}}
    )
    context = mi.BSDFContext()
    context.type_mask = mi.BSDFFlags.Diffuse
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(float(np.sqrt(1 - view**2)), 0, view)
    value = bsdf.eval(context, si, mi.Vector3f(0, float(np.sqrt(1 - light**2)), light))
    return float(np.ravel(np.array(value))[0]) * np.pi / light / ALBEDO


@pytest.mark.parametrize("alpha", [0.1, 0.4])
def test_the_matte_lobe_is_mitsubas(alpha):
    found = coat(alpha)
    cosines = np.linspace(0, 1, len(found.through))
    for view, light in ((1.0, 0.8), (0.5, 0.9), (0.3, 0.4)):
        through = np.interp([view, light], cosines, found.through)
        closed = through[0] * through[1] / (IOR**2 * (1 - found.within))
        assert closed == pytest.approx(mitsuba_matte(alpha, view, light), rel=4e-3)
        layer = np.interp(view, cosines, found.weights) * found.of_one_light(light)
        assert layer == pytest.approx(closed, rel=1e-12), "a layer's weight times the factor of that light is the lobe"


@pytest.mark.parametrize("alpha", [0.1, 0.4])
def test_gloss_is_mitsubas(alpha):
    mi = load_mitsuba()
    if mi.variant().startswith("scalar"):
        pytest.skip("a sum over directions needs a variant that computes many at once")
    bsdf = mi.load_dict({"type": "roughplastic", "alpha": alpha, "diffuse_reflectance": {"type": "rgb", "value": 0.0}})
    z, around = (
        a.ravel() for a in np.meshgrid((np.arange(2000) + 0.5) / 2000, 2 * np.pi * (np.arange(500) + 0.5) / 500)
    )
    for cosine in (0.9, 0.5):
        si = mi.SurfaceInteraction3f()
        si.wi = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, cosine)
        out = np.stack([np.sqrt(1 - z**2) * np.cos(around), np.sqrt(1 - z**2) * np.sin(around), z]).astype(np.float32)
        total = (
            2 * np.pi * float(np.mean(np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(out)))[0], dtype=np.float64))
        )
        assert crossing(alpha, cosine, IOR)[0] == pytest.approx(total, rel=5e-3)


def test_a_smooth_coat_is_a_pane():
    for cosine in (0.2, 0.6, 1.0):
        reflected, passed = crossing(1e-3, cosine, IOR)
        assert reflected == pytest.approx(float(fresnel(np.array(cosine), IOR)[0]), rel=1e-3)
        assert reflected + passed == pytest.approx(1, abs=1e-6), "no second facet is met"
    assert crossing(1e-3, 0.5, 1 / IOR)[0] == pytest.approx(1, abs=1e-9), "total reflection from within"
    assert sum(crossing(0.4, 0.3, IOR)) < 0.97, "rough facets hide behind each other"


def test_a_layer_reflects_as_much_of_uniform_light():
    found = coat(0.25)
    cosines = np.linspace(0, 1, 4001)
    assert 2 * np.trapezoid(cosines * [found.of_one_light(c) for c in cosines], cosines) == pytest.approx(1, abs=1e-3)
