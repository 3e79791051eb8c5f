"""numba's CUDA simulator for tests: each case is compared in this process, which needs NUMBA_ENABLE_CUDASIM=1.

    python cuda_simulator.py CASE...

The simulator runs a block's threads as Python threads, which takes most of the time: hundreds of them wait for each
other. Here they are generators in one thread. They run in turns, in the order of their indices.
"""

import ast
import inspect
import sys
import textwrap
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any

import numpy as np
import torch
from numba.cuda.simulator import kernel
from numba.cuda.simulator.cudadrv.devicearray import FakeWithinKernelCUDAArray
from numba.cuda.simulator.kernelapi import Dim3, FakeCUDAShared
from numba.np.numpy_support import as_dtype
from splat_parity import compare
from splat_scenes import HARD, HEIGHT, LENSES, WIDTH, changed, opaque_stack, random_splats, through, views

from spike4dgs.method.splat import Splats, Views, render
from spike4dgs.method.splat.cuda.background import make_layer, render_over
from spike4dgs.method.splat.types import CUSTOMARY

SCALE = 0.22  # of the image: 22 x 15 pixels are two tiles


class _Pausing(ast.NodeTransformer):
    """Turns a kernel into a generator that pauses where the kernel waits for the other threads of its block."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.decorator_list = []
        return self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> ast.AST:
        if isinstance(node.func, ast.Attribute) and node.func.attr in ("syncthreads", "syncthreads_count"):
            return ast.Yield(*node.args)
        return self.generic_visit(node)


@cache
def pausing(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a kernel's function as a generator function, or as it is if its threads do not wait.

    It yields the argument of `syncthreads_count`, and is sent the count.
    """
    names = function.__code__.co_freevars
    inner = _Pausing().visit(ast.parse(textwrap.dedent(inspect.getsource(function)))).body[0]
    ast.increment_lineno(inner, function.__code__.co_firstlineno - 1)
    outer = ast.parse(f"def outer({', '.join(names)}):\n    return {function.__name__}")
    outer.body[0].body.insert(0, inner)  # type: ignore[attr-defined]
    found: dict[str, Any] = {}
    exec(compile(ast.fix_missing_locations(outer), inspect.getfile(function), "exec"), function.__globals__, found)
    return found["outer"](*(cell.cell_contents for cell in function.__closure__ or ()))  # type: ignore[no-any-return]


def run_block(self: Any, grid_point: Any, *args: Any) -> None:
    """Run one block's threads in turns, each to where it waits for the others, to their end.

    They have the plain arrays: the simulator's own look at all names of an array to find its shape.
    """
    args = tuple(a._item._ary if isinstance(a, FakeWithinKernelCUDAArray) else a for a in args)
    here: Any = threading.current_thread()  # which the simulator asks for the indices
    here.blockIdx = Dim3(*grid_point)
    indices = [Dim3(*point) for point in np.ndindex(*self._block_dim)]
    turns = []
    for here.threadIdx in indices:
        turns.append(pausing(self._f)(*args))
    if not inspect.isgeneratorfunction(pausing(self._f)):
        return
    count = None
    while True:
        said = []
        for here.threadIdx, turn in zip(indices, turns, strict=True):
            with suppress(StopIteration):
                said.append(turn.send(count))
        assert len(said) in (0, len(turns)), "some threads wait for threads that have ended"
        if not said:
            return
        count = sum(map(bool, said))


def shared_array(self: Any, shape: Any, dtype: Any) -> Any:
    """Return the array that a block's threads share. The simulator's own reads the whole stack to know the line."""
    line = sys._getframe(1).f_lineno
    if line not in self._allocations:
        self._allocations[line] = np.empty(shape, as_dtype(dtype))
    return self._allocations[line]


def small(splats: Splats, v: Views, count: int = 12) -> tuple[Splats, Views]:
    """Return some of the Gaussians in smaller images of the first view or two."""
    step = max(1, len(splats) // count)
    K = v.K.clone()
    K[:, :2] *= SCALE
    few = Splats(*(t[::step][:count] for t in splats.tensors))
    return few, Views(v.w2c[-1:], K[-1:], round(WIDTH * SCALE), round(HEIGHT * SCALE))


def behind_and_over() -> None:
    """A background and others in front of it against all of them at once: equal bits, and equal gradients."""
    splats, v = small(random_splats(24, 2, seed=31), views(2), 24)
    v = Views(torch.cat([views(2).w2c[:1], v.w2c]), v.K.repeat(2, 1, 1), v.width, v.height)
    behind = Splats(*(t[:18] for t in splats.tensors))
    # In a corner: the other tile is copied.
    corner = splats.means[18:] * 0.1 + torch.tensor([-0.3, 0.0, 1.0])
    front = [corner, splats.quats[18:], splats.scales[18:] * 0.2, splats.opacities[18:], splats.colors[18:]]
    results = []
    for joined in (True, False):
        leaves = [t.clone().requires_grad_() for t in front]
        if joined:
            pairs = zip((*behind.geometry, behind.colors), leaves, strict=True)
            one = Views(v.w2c[[1]], v.K[[1]], v.width, v.height)
            out = render(Splats(*(torch.cat(p) for p in pairs)), one, backend="cuda")
        else:
            out = render_over(make_layer(behind, v, CUSTOMARY), Splats(*leaves), [1])
        g = torch.Generator().manual_seed(1)
        (out.image * torch.randn(out.image.shape, generator=g)).sum().backward()
        assert out.means2d.grad is not None
        grads = [*(t.grad for t in leaves), out.means2d.grad[:, -6:]]
        results.append([out.image.detach(), out.alpha.detach(), *grads, out.radii[:, -6:]])
    assert (results[0][-1] > 0).any()
    for a, b in zip(*results, strict=True):
        assert torch.equal(a, b)


def same_bits() -> None:
    """Two renders of the same give the same bits, gradients too."""
    splats, v = small(random_splats(24, 1, seed=32), views(1))
    results = []
    for _ in range(2):
        leaves = [t.clone().requires_grad_() for t in splats.tensors]
        out = render(Splats(*leaves), v, backend="cuda")
        out.image.square().sum().backward()
        results.append([out.image.detach(), *(t.grad for t in leaves)])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def random_case(seed: int, channels: int, depth: bool, antialiased: bool) -> Callable[[], None]:
    """Return the comparison of random Gaussians."""
    return lambda: compare(
        *small(random_splats(24, channels, seed=seed), views(1)), "cuda", depth=depth, antialiased=antialiased
    )


def lens_case(lens: tuple[float, ...]) -> Callable[[], None]:
    """Return the comparison of random Gaussians, in the image and far beyond it, through a lens."""

    def compared() -> None:
        s, v = small(random_splats(24, 1, seed=33), views(1))
        aside = torch.where(torch.arange(len(s)) % 3 > 0, 1.0, 4.0)[:, None] ** torch.tensor([1.0, 1.0, 0.0])
        wide = changed(s, means=s.means * aside, scales=s.scales * aside[:, :1])
        compare(wide, through(v, lens), "cuda", depth=True, antialiased=True)

    return compared


CASES: dict[str, Callable[[], None]] = {
    # Of opaque ones only many finish a pixel early.
    **{f.__name__: (lambda f=f: compare(*small(*f(), 24 if f is opaque_stack else 12), "cuda")) for f in HARD},
    "one channel": random_case(1, 1, False, False),
    "three channels with depth": random_case(2, 3, True, True),
    "five channels": random_case(3, 5, False, False),
    **{name: lens_case(lens) for name, lens in LENSES.items()},
    "behind and over": behind_and_over,
    "same bits": same_bits,
}


if __name__ == "__main__":
    kernel.BlockManager.run, FakeCUDAShared.array = run_block, shared_array
    for name in sys.argv[1:]:
        CASES[name]()
        print(name)
