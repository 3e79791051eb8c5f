"""The judgement whether gsplat, which renders Gaussians on CUDA, works here, without importing or building it.

gsplat's wheel on PyPI has sources only. The first import compiles them with a CUDA toolkit, a C++ compiler and ninja,
and every later import looks for these again. Its authors also publish wheels that are compiled already.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sysconfig
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

EXTRA = "pip install 'spike4dgs[cuda]'"
PYTORCH = "install PyTorch with CUDA from pytorch.org"


@dataclass(frozen=True)
class Missing:
    """A part that rendering on CUDA needs and this machine lacks, and what to do."""

    expected: str
    found: str
    fix: str


def missing_rasterizer() -> Missing | None:
    """Return the first part that gsplat lacks here; None where it is compiled or can be. A device is not looked for."""
    import torch

    spec = find_spec("gsplat")
    if spec is None or not spec.submodule_search_locations:
        return Missing("the package gsplat", "none", f"{EXTRA}, which also needs a CUDA toolkit")
    if torch.version.cuda is None:
        return Missing("a PyTorch with CUDA", f"torch {torch.__version__}", PYTORCH)
    if any(found for place in spec.submodule_search_locations for found in Path(place).glob("csrc.*")):
        return None
    return _missing_compiler(torch.version.cuda)


def _missing_compiler(cuda: str) -> Missing | None:
    """Return what compiling kernels for PyTorch's CUDA version lacks."""
    toolkit = f"the CUDA toolkit {cuda}"
    advice = f"install {toolkit} with nvcc on PATH, or a compiled wheel from docs.gsplat.studio/whl"
    nvcc = _nvcc()
    if nvcc is None:
        return Missing(f"{toolkit}, to compile gsplat", "no nvcc", advice)
    release = _release(nvcc)
    if release is None or release.partition(".")[0] != cuda.partition(".")[0]:
        return Missing(f"{toolkit}, to compile gsplat", f"{nvcc} of {release or 'an unknown version'}", advice)
    compiler = os.environ.get("CXX", "c++")
    if shutil.which(compiler) is None:
        return Missing("a C++ compiler, to compile gsplat", f"no {compiler}", "install one (Debian: apt install g++)")
    if not Path(sysconfig.get_paths()["include"], "Python.h").is_file():
        return Missing("Python's headers, to compile gsplat", "no Python.h", "install them (Debian: python3-dev)")
    if shutil.which("ninja") is None:
        return Missing("ninja on PATH, to compile gsplat", "none", f"activate the environment, or {EXTRA}")
    return None


def _nvcc() -> str | None:
    """Return the compiler that PyTorch would call: of CUDA_HOME or CUDA_PATH, else on PATH, else the usual folder's."""
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    places = (f"{home}/bin/nvcc",) if home else ("nvcc", "/usr/local/cuda/bin/nvcc")
    return next(filter(None, map(shutil.which, places)), None)


def _release(nvcc: str) -> str | None:
    """Return the toolkit's version, such as 12.8."""
    try:
        text = subprocess.run([nvcc, "--version"], capture_output=True, text=True, timeout=20).stdout
    except (OSError, subprocess.TimeoutExpired):
        return None
    found = re.search(r"release (\d+\.\d+)", text)
    return found[1] if found else None
