"""The judgement whether Gaussians can be rendered on CUDA here, by numba-cuda, which compiles without a toolkit.

The compiler comes with the package's extra for a version of CUDA. Whether it, the driver and PyTorch go together is
known only from a trial, so one is made: a kernel of one line, compiled and run on a tensor.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

PYTORCH = "install PyTorch with CUDA from pytorch.org"


@dataclass(frozen=True)
class Missing:
    """A part that rendering on CUDA needs and this machine lacks, and what to do."""

    expected: str
    found: str
    fix: str


def install_line() -> str:
    """Return the line that installs numba-cuda with the compiler for PyTorch's version of CUDA."""
    import torch

    extra = "cuda12" if (torch.version.cuda or "").startswith("12.") else "cuda"
    return f"pip install 'spike4dgs[{extra}]'"


def missing_rasterizer() -> Missing | None:
    """Return the first part that rendering on CUDA lacks here; None where it works. PyTorch must see a device."""
    import torch

    if find_spec("numba_cuda") is None:
        return Missing("the package numba-cuda", "none", install_line())
    if torch.version.cuda is None:
        return Missing("a PyTorch with CUDA", f"torch {torch.__version__}", PYTORCH)
    failure = trial()
    if failure:
        return Missing("a numba-cuda that works with the driver", failure, f"{install_line()}, or update the driver")
    return None


@cache
def trial() -> str:
    """Compile a kernel and run it on a tensor of the first device; return what fails, or nothing."""
    import torch

    try:
        cuda: Any = import_module("numba.cuda")

        def add_one(a: Any) -> None:
            a[0] += 1

        one = torch.ones(1, device="cuda")
        cuda.jit(add_one)[1, 1](cuda.as_cuda_array(one))
        cuda.synchronize()
        return "" if one.item() == 2 else "a wrong sum"
    except Exception as e:  # the driver, the compiler and their bindings each have their own
        return f"{type(e).__name__}: {str(e).strip().partition(chr(10))[0]}"
