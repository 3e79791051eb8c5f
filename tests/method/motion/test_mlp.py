"""The perceptron's vector code beside three layers in float64."""

import numpy as np
import pytest
import torch

from spike4dgs.method.motion import mlp_cpu
from spike4dgs.method.motion.mlp import perceptron, perceptron_reference
from spike4dgs.method.motion.mlp_cpu import BLOCK, add_product

FOUR_D = (32, 32, 160, (3, 3, 4, 1, 1))  # of the motion `hexplane`
ODD = (7, 13, 33, (2, 9, 1))  # no width is a whole number of vectors, and a head is wider than one
ONE_HEAD = (16, 24, 24, (3,))


def layers_of(shape, g):
    inputs, first, second, heads = shape
    sizes = [(first, inputs), (first,), (second, first), (second,)]
    for size in heads:
        sizes += [(size, second // len(heads)), (size,)]
    return [torch.randn(s, generator=g) / s[-1] ** 0.5 for s in sizes]


@pytest.mark.parametrize("shape", [FOUR_D, ODD, ONE_HEAD])
@pytest.mark.parametrize("rows", [0, 1, BLOCK - 1, 2 * BLOCK, 1500])
def test_values_and_gradients_are_those_of_three_layers(shape, rows):
    g = torch.Generator().manual_seed(rows)
    x, layers = torch.randn(rows, shape[0], generator=g), layers_of(shape, g)
    weights = [torch.randn(rows, size, generator=g) for size in shape[3]]
    found = []
    for f, dtype in ((perceptron, torch.float32), (perceptron_reference, torch.float64)):
        leaves = [v.detach().to(dtype, copy=True).requires_grad_() for v in (x, *layers)]
        out = f(leaves[0], leaves[1:])
        sum((o * w.to(dtype)).sum() for o, w in zip(out, weights, strict=True)).backward()
        found.append([*(o.detach() for o in out), *(v.grad for v in leaves)])
    for fast, exact in zip(*found, strict=True):
        assert fast.shape == exact.shape
        if exact.numel():
            assert (fast - exact).abs().max() <= 2e-6 * exact.abs().max().clamp(min=1)


def test_a_head_that_nothing_asks_for_has_no_gradient():
    g = torch.Generator().manual_seed(1)
    layers = [v.requires_grad_() for v in layers_of(ODD, g)]
    perceptron(torch.randn(5, 7, generator=g), layers)[1].sum().backward()
    assert [bool(v.grad.any()) for v in layers[4:]] == [False, False, True, True, False, False]


def test_what_is_no_number_stays_in_its_row():
    g = torch.Generator().manual_seed(2)
    x = torch.randn(BLOCK + 3, 32, generator=g)
    x[BLOCK + 1, 5] = float("nan")
    for out in perceptron(x, layers_of(FOUR_D, g)):
        assert torch.nonzero(out.isnan().all(1))[:, 0].tolist() == [BLOCK + 1] and out.isnan().any(1).sum() == 1


@pytest.mark.parametrize(("m", "n", "k"), [(4, 16, 8), (7, 27, 5), (1, 1, 1), (5, 8, 0)])
def test_a_product_reads_and_writes_its_part_of_the_arrays_alone(m, n, k):
    """A is read by columns, B and C are parts of wider arrays."""
    rng = np.random.default_rng(3)
    a, b, c = (rng.standard_normal(s).astype(np.float32) for s in ((k + 1, m), (k + 2, n + 3), (m + 1, n + 5)))
    expected = c.astype(np.float64)
    expected[1:, 2 : n + 2] = np.maximum(expected[1:, 2 : n + 2] + a[1:].T.astype(float) @ b[1 : k + 1, 3:], 0.25)
    add_product(a, m, 1, m, b, n + 3 + 3, n + 3, c, n + 5 + 2, n + 5, m, n, k, np.float32(0.25))
    np.testing.assert_allclose(c, expected, rtol=1e-5, atol=1e-6)


def test_parts_of_kernels_have_names_of_their_own() -> None:
    """Two kernels from the cache, compiled in two processes, are linked by the names of what they call.

    With one name for three codes, a gradient compiled after the values were, in another process, called the wrong one.
    """
    names = {part.py_func.__qualname__ for part in (mlp_cpu._wide, mlp_cpu._narrow, mlp_cpu._column)}
    assert len(names) == 3
