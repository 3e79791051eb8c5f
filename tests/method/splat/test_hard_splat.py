"""Hard scenes on the device of the report: images and gradients beside the float64 reference, and refusals."""

from functools import cache

import pytest
import splat_scenes
from hard_case import REFUSAL, HardCase
from splat_parity import GRADIENT_TOLERANCE, IMAGE_TOLERANCE, MOST_ON_CUTOFF, NAMES, Parity, parity
from splat_scenes import changed, random_splats, views

from spike4dgs.benchmark.environment import device_type
from spike4dgs.method.splat import render

SCENES = {
    "random": (lambda: (random_splats(150, 3, seed=20), views()), "150 Gaussians of all sizes in three colours"),
    "behind": (splat_scenes.behind, "Gaussians behind the camera, huge ones among them"),
    "near-plane": (splat_scenes.near_plane, "centres from behind the camera to just beyond the near plane"),
    "needles": (splat_scenes.needles, "needles, one axis 10,000 times the others"),
    "pancakes": (splat_scenes.pancakes, "flat discs, a third of them seen edge-on"),
    "tiny-and-huge": (splat_scenes.tiny_and_huge, "standard deviations of 1e-6 and 1e3, also within one Gaussian"),
    "opacities": (splat_scenes.opacities, "opacities of 0, 1/255, almost 1 and 1"),
    "equal-depths": (splat_scenes.equal_depths, "all centres at one depth, pairs at one point"),
    "off-screen": (splat_scenes.off_screen, "Gaussians beside and above the image, and behind the camera"),
    "empty": (splat_scenes.nothing, "no Gaussian at all"),
    "far-origin": (splat_scenes.far_origin, "a scene and its cameras 10 km from the origin, float64 inputs"),
    "opaque-stack": (splat_scenes.opaque_stack, "400 opaque Gaussians behind each other"),
    "zero-quaternions": (splat_scenes.zero_quaternions, "a third of the quaternions are zero"),
    "crowd": (splat_scenes.crowd, "100,000 faint Gaussians in front of one pixel"),
}
TWIN = "every pixel against every Gaussian, float64, autograd"
each_scene = pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.hard_case(asked=f"rendering {s[1]}")) for n, s in SCENES.items()]
)


@cache  # for a scene's two rows, which do not follow each other
def seen(name: str, device: str) -> Parity:
    """Return the parity of a scene, antialiased with depth: `test_cpu` and `test_device` compare the plain ones."""
    return parity(*SCENES[name][0](), device_type(device), device, depth=True, antialiased=True)


@pytest.mark.hard_case(twin=TWIN, unit="of white", tolerance=IMAGE_TOLERANCE, on_device=True)
@each_scene
def test_image(hard_case: HardCase, name: str) -> None:
    found = seen(name, hard_case.device)
    cut = found.on_cutoff
    text = f"{cut:.2%} of the pixels on a cut-off, not compared" if cut else "all pixels compared"
    assert found.visible, "other Gaussians are visible"
    assert cut <= MOST_ON_CUTOFF, f"{text}: too many to say anything"
    hard_case.check(found.image, text, found.finite_image)


@pytest.mark.hard_case(twin=TWIN, unit="relative L2", tolerance=GRADIENT_TOLERANCE, on_device=True)
@each_scene
def test_gradient(hard_case: HardCase, name: str) -> None:
    found = seen(name, hard_case.device)
    text = f"seven gradients; the worst is that of {found.worst_leaf}"
    hard_case.check(found.gradient, text, found.finite_gradient)


@pytest.mark.hard_case(asked="NaN and infinity in each of the five tensors", **REFUSAL, on_device=True)
def test_refuse(hard_case: HardCase) -> None:
    splats, v = random_splats(5, seed=hard_case.seed), views(1)
    moved = changed(splats, **{n: getattr(splats, n).to(hard_case.device) for n in NAMES[:5]})
    calls = {}
    for name in NAMES[:5]:
        for value in (float("nan"), float("inf")):
            broken = getattr(moved, name).clone()
            broken[3] = value
            bad = changed(moved, **{name: broken})
            calls[f"{value} in {name}"] = lambda bad=bad: render(bad, v, backend=device_type(hard_case.device))
    hard_case.refused(calls)
