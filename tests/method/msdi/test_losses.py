"""The losses of MSDI's training against loops and closed forms."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from spike4dgs.method.msdi.losses import ALPHA, image_loss, point_loss

SHAPE = (2, 3, 4, 5)


def random_case(seed: int, share: float = 0.7) -> tuple[Tensor, Tensor, Tensor]:
    """Return points, confidence and truth, float64; the truth of about `share` of the pixels is finite."""
    g = torch.Generator().manual_seed(seed)
    points, truth = (torch.randn(*SHAPE, 3, generator=g, dtype=torch.float64) + 2 for _ in range(2))
    confidence = 1 + torch.rand(*SHAPE, generator=g, dtype=torch.float64) * 4
    truth[torch.rand(*SHAPE, generator=g) >= share] = torch.nan
    return points, confidence, truth


def twin(points: Tensor, confidence: Tensor, truth: Tensor) -> float:
    """Return the loss by loops."""
    p, c, x = (t.detach().numpy() for t in (points, confidence, truth))
    terms = []
    for sample in range(p.shape[0]):
        counting = [k for k in np.ndindex(*p.shape[1:4]) if np.isfinite(x[sample][k]).all()]
        if not counting:
            continue
        z = sum(float(np.sqrt((p[sample][k] ** 2).sum())) for k in counting) / len(counting)
        zgt = sum(float(np.sqrt((x[sample][k] ** 2).sum())) for k in counting) / len(counting)
        for k in counting:
            off = float(np.sqrt(((p[sample][k] / z - x[sample][k] / zgt) ** 2).sum()))
            terms.append(c[sample][k] * off - 0.2 * np.log(c[sample][k]))
    return float(np.mean(terms)) if terms else 0.0


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.0, 0.05, 0.7, 1.0]))
def test_point_loss_equals_loops(seed: int, share: float) -> None:
    parts = random_case(seed, share)
    assert float(point_loss(*parts)) == pytest.approx(twin(*parts), abs=1e-12)
    single = [t.float() for t in parts]
    assert float(point_loss(*single)) == pytest.approx(twin(*parts), abs=1e-5)


def test_scale_of_a_sample_is_free_and_that_of_a_view_is_not() -> None:
    points, confidence, truth = random_case(0)
    loss = point_loss(points, confidence, truth)
    scales = torch.tensor([0.01, 30.0], dtype=torch.float64)[:, None, None, None, None]
    assert torch.allclose(point_loss(scales * points, confidence, truth), loss)
    assert torch.allclose(point_loss(points, confidence, scales * truth), loss)
    one_view = points.clone()
    one_view[:, 1] *= 2  # the views of a sample share their scale
    assert abs(float(point_loss(one_view, confidence, truth) - loss)) > 1e-3
    exact = -ALPHA * confidence[truth.isfinite().all(dim=-1)].log().mean()
    assert float(point_loss(truth.nan_to_num(), confidence, truth)) == pytest.approx(float(exact))


def test_pixels_that_do_not_count_change_nothing_and_have_no_gradient() -> None:
    points, confidence, truth = random_case(1)
    valid = truth.isfinite().all(dim=-1)
    spoilt = points.where(valid[..., None], 1e3)
    loss = point_loss(spoilt, confidence, truth)
    points, confidence = points.requires_grad_(), confidence.requires_grad_()
    out = point_loss(points, confidence, truth)
    out.backward()
    assert torch.equal(out, loss)
    assert points.grad is not None and points.grad.isfinite().all() and (points.grad[~valid] == 0).all()
    assert confidence.grad is not None and (confidence.grad[~valid] == 0).all()
    assert (points.grad[valid] != 0).any(dim=-1).all()


def test_truth_that_is_not_finite_counts_as_absent() -> None:
    points, confidence, truth = random_case(2)
    truth[0, 1] = torch.nan
    truth[1, 0, 0, 0, 2] = torch.inf
    out = point_loss(points.requires_grad_(), confidence, truth)
    out.backward()
    assert float(out.detach()) == pytest.approx(twin(points, confidence, truth))
    assert points.grad is not None and points.grad.isfinite().all()


def test_no_valid_pixel_gives_zero_and_zero_gradient() -> None:
    points, confidence, truth = random_case(3, 0.0)
    out = point_loss(points.requires_grad_(), confidence.requires_grad_(), truth)
    out.backward()
    assert float(out.detach()) == 0 and points.grad is not None and confidence.grad is not None
    assert (points.grad == 0).all() and (confidence.grad == 0).all()


@pytest.mark.parametrize("points", [torch.zeros(*SHAPE, 3), torch.ones(*SHAPE, 3)])
def test_points_at_the_origin_or_all_equal_are_finite(points: Tensor) -> None:
    points = points.requires_grad_()
    out = point_loss(points, 1 + torch.ones(SHAPE), torch.zeros(*SHAPE, 3))
    out.backward()
    assert out.isfinite() and points.grad is not None and points.grad.isfinite().all()


def test_gradients_agree_with_differences() -> None:
    points, confidence, truth = random_case(4)
    small = slice(0, 1), slice(0, 2), slice(0, 2), slice(0, 2)
    a, b = points[small].clone().requires_grad_(), confidence[small].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda p, c: point_loss(p, c, truth[small]), (a, b))


def test_best_confidence_is_alpha_over_the_error() -> None:
    points, _, truth = random_case(5, 1.0)
    confidence = torch.full(SHAPE, 1.0, dtype=torch.float64, requires_grad=True)
    out = point_loss(points, confidence, truth)
    (slope,) = torch.autograd.grad(out, confidence)
    error = slope * confidence.numel() + ALPHA  # from d/dC (C e - alpha log C) at C = 1
    best = (ALPHA / error).detach().requires_grad_()
    (slope,) = torch.autograd.grad(point_loss(points, best, truth), best)
    assert slope.abs().max() < 1e-12


def test_image_loss() -> None:
    g = torch.Generator().manual_seed(0)
    images, truth = torch.rand(SHAPE, generator=g), torch.rand(SHAPE, generator=g)
    by_hand = np.abs(images.double().numpy() - truth.double().numpy())
    assert float(image_loss(images, truth)) == pytest.approx(by_hand.mean(), rel=1e-5)
    truth[0, 0] = torch.nan
    out = image_loss(images.requires_grad_(), truth)
    out.backward()
    kept = np.isfinite(truth.numpy())
    assert float(out.detach()) == pytest.approx(by_hand[kept].mean(), rel=1e-5)
    assert images.grad is not None and images.grad.isfinite().all() and (images.grad[0, 0] == 0).all()
    assert image_loss(images, torch.full(SHAPE, torch.nan)) == 0
