"""Rendering through lenses: kernels against the float64 twin, the twin against OpenCV and finite differences."""

from collections.abc import Callable
from dataclasses import fields

import cv2
import numpy as np
import pytest
import splat_parity
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from splat_scenes import BARREL, CUSHION, HARD, LENSES, changed, far_origin, random_splats, through, views

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.lens import fold_radius
from spike4dgs.method.splat import Splats, Views, render
from spike4dgs.method.splat.background import Background, Repeated, join
from spike4dgs.method.splat.reference import Projection, project, project_view, rotation_matrices
from spike4dgs.method.splat.types import CUSTOMARY

every_lens = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)


@pytest.mark.parametrize("lens", [BARREL, LENSES["tangential"]], ids=["barrel", "tangential"])  # of a fold, and none
@pytest.mark.parametrize("scene", [scene for scene in HARD if scene is not far_origin])
def test_hard_scenes(scene: Callable[[], tuple[Splats, Views]], lens: tuple[float, ...]) -> None:
    splats, v = scene()
    splat_parity.compare(Splats(*(t[:60].float() for t in splats.tensors)), through(v, lens), "cpu")


@settings(max_examples=15, deadline=None)
@given(
    st.integers(0, 10**6),
    st.tuples(*[st.floats(-b, b) for b in (0.2, 0.1, 0.03, 0.03, 0.05)]),
    st.floats(0, 6),
    st.booleans(),
)
def test_random_scenes(seed: int, lens: tuple[float, ...], spread: float, antialiased: bool) -> None:
    """In the image, at its border, far beyond it, and beyond the fold."""
    s = random_splats(80, seed=seed)
    aside = torch.tensor([1 + spread, 1 + spread, 1.0])
    s = changed(s, means=s.means * aside, scales=s.scales * (1 + 3 * spread))
    splat_parity.compare(s, through(views(1), lens), "cpu", depth=True, antialiased=antialiased)


def test_views_of_several_lenses_and_of_none() -> None:
    s, v = random_splats(60, 3, seed=41), views(3)
    splat_parity.compare(s, through(v, BARREL, (), CUSHION), "cpu", depth=True)
    mixed, alone = render(s, through(v, BARREL, (), CUSHION)), render(s, v)
    torch.testing.assert_close(mixed.image[1], alone.image[1], atol=1e-6, rtol=0)
    assert not torch.allclose(mixed.image[0], alone.image[0], atol=1e-2)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@every_lens
def test_centres_lie_where_opencv_puts_them(lens: tuple[float, ...], backend: str) -> None:
    s, v = random_splats(200, seed=42), views()
    out = render(changed(s, scales=s.scales * 0.01), through(v, lens), backend=backend)  # type: ignore[arg-type]
    seen = 0
    for c in range(2):
        R, t = v.w2c[c, :3, :3].numpy(), v.w2c[c, :3, 3].numpy()
        expected = cv2.projectPoints(s.means.numpy(), cv2.Rodrigues(R)[0], t, v.K[c].numpy(), np.array(lens))[0][:, 0]
        visible = out.visible[c].numpy()
        np.testing.assert_allclose(out.means2d[c].detach().numpy()[visible], expected[visible], atol=1e-9)
        seen += visible.sum()
    assert seen > 100


@every_lens
def test_a_small_gaussian_has_the_shape_that_its_points_have(lens: tuple[float, ...]) -> None:
    s, v = random_splats(40, seed=43), views(1)
    s = changed(s, scales=1e-3 * s.scales)
    found = project_view(s, through(v, lens), 0, CUSTOMARY)
    blur = torch.tensor([CUSTOMARY.variance, 0.0, CUSTOMARY.variance], dtype=torch.float64)
    axes = (rotation_matrices(s.quats) * s.scales[:, None]).numpy()
    R, t = v.w2c[0, :3, :3].numpy(), v.w2c[0, :3, 3].numpy()

    def pixels(points: np.ndarray) -> np.ndarray:
        return cv2.projectPoints(points, cv2.Rodrigues(R)[0], t, v.K[0].numpy(), np.array(lens))[0][:, 0]

    assert len(found.index) > 10
    for m, i in enumerate(found.index.tolist()):
        at = s.means[i].numpy()
        half = np.stack(
            [(pixels((at + axes[i, :, k])[None]) - pixels((at - axes[i, :, k])[None]))[0] / 2 for k in range(3)]
        )
        cov = half.T @ half
        wanted = [cov[0, 0], cov[0, 1], cov[1, 1]]
        np.testing.assert_allclose((found.cov[m] - blur).numpy(), wanted, atol=1e-4 * cov.max())


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_nothing_is_seen_beyond_the_fold(backend: str) -> None:
    lens = (-0.3, 0.0, 0.0, 0.0, 0.0)
    fold, s = fold_radius(lens), random_splats(4, seed=44)
    u = torch.tensor([0.3, 0.99 * fold, 1.01 * fold, 1.8], dtype=torch.float64)  # the last leads back into the image
    means = torch.stack([u * 2, 0 * u, 0 * u + 2], 1)
    wide = changed(s, means=means, scales=torch.full((4, 3), 0.3, dtype=torch.float64), opacities=0.9 + 0 * u)
    out = render(wide, through(views(1), lens), backend=backend)  # type: ignore[arg-type]
    assert out.visible[0].tolist() == [True, True, False, False]


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_nothing_is_seen_where_tangential_terms_mirror(backend: str) -> None:
    lens = (0.0, 0.0, 0.0, 0.05, 0.0)  # x' = x + 0.15 x^2 leads back to the middle at x = -6.7
    s = random_splats(2, seed=45)
    means = torch.tensor([[0.1, 0.0, 1.0], [-6.7, 0.0, 1.0]], dtype=torch.float64)
    out = render(changed(s, means=means), through(views(1), lens), backend=backend)  # type: ignore[arg-type]
    assert out.visible[0].tolist() == [True, False]


def numbers(view: Projection) -> tuple[torch.Tensor, ...]:
    return tuple(getattr(view, f.name) for f in fields(view) if f.name in ("center", "cov", "det", "opacity", "depth"))


@every_lens
def test_the_twins_gradient_is_that_of_finite_differences(lens: tuple[float, ...]) -> None:
    s, v = random_splats(3, seed=46), through(views(1), lens)
    aside = s.means.clone()
    aside[0, 0] += 1.6  # outside of the image, where the projection is linearised inside
    leaves = [t.clone().requires_grad_() for t in (aside, *s.tensors[1:4], v.w2c[0])]

    def projected(*given: torch.Tensor) -> tuple[torch.Tensor, ...]:
        splats = Splats(*given[:4], s.colors)
        return numbers(project(splats, given[4], v.K[0], (v.width, v.height), CUSTOMARY, v.lenses[0]))

    assert torch.autograd.gradcheck(projected, leaves, eps=1e-6, atol=1e-5, rtol=1e-5)


def test_a_background_has_the_same_bits() -> None:
    s, v = random_splats(200, seed=47), through(views(3), BARREL, (), CUSHION)
    s = Splats(*(t.float() for t in s.tensors))
    behind, front = (Splats(*(t[part] for t in s.tensors)) for part in (slice(0, 150), slice(150, 200)))
    out = Background(behind, v).render(front, [2, 0])
    whole = render(join(behind, front), v.some([2, 0]))
    assert torch.equal(out.image, whole.image) and torch.equal(out.alpha, whole.alpha)
    kept = Repeated(behind, CUSTOMARY)
    assert kept.in_view(v.some([0])) is None and kept.in_view(through(views(3), BARREL).some([1])) is None
    assert kept.in_view(v.some([1])) is None, "the same pose, but no lens"


def test_a_lens_that_folds_within_the_image_is_refused() -> None:
    camera = Camera("cam_00", 40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(3), np.zeros(3), (-5.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(UserError, match="a lens of cam_00 whose model holds up to the image's corners"):
        Views.from_cameras([camera])
    with pytest.raises(UserError, match=r"Views.lenses: expected shape \(2, 10\)"):
        Views(views().w2c, views().K, 10, 10, torch.zeros(2, 5))
