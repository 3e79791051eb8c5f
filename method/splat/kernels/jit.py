"""Compilation of the kernels: numba's options, the source digest and the notice of a first compile."""

from __future__ import annotations

import hashlib
import logging
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numba import njit

from spike4dgs.benchmark.compilation import cached_njit

log = logging.getLogger(__name__)

# No reassociation: results must not depend on how LLVM cuts a loop. No OpenMP: see threads.py.
_OPTIONS: dict[str, Any] = {
    "fastmath": {"contract", "nsz", "arcp", "afn"},
    "error_model": "numpy",
    "boundscheck": False,
    "nogil": True,
}
# Only kernels are called from Python: numba's ways into a helper from there would be a fifth of its compilation.
_INSIDE: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, **_OPTIONS}
_lock = threading.Lock()
_announced = False


def kernel(function: Callable[..., Any]) -> Any:
    """Compile on first call and keep the machine code; `benchmark/compilation.py` says where."""
    return cached_njit(**_OPTIONS)(function)


def helper(function: Callable[..., Any]) -> Any:
    """Compile a function that exists only inlined into kernels."""
    return njit(forceinline=True, **_INSIDE)(function)


def template(function: Callable[..., Any]) -> Any:
    """Compile a helper that is inlined before type inference, so that literal arguments stay literal inside."""
    return njit(inline="always", **_INSIDE)(function)


@cache
def source_digest() -> int:
    """Return 24 bits of the digest of the sources of `method/splat`.

    numba invalidates its cache by the one file that holds a kernel. The kernels here inline others' code, so a
    changed neighbour must change something that the cache key does hold: an integer in the kernel's closure.
    """
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    return int.from_bytes(digest.digest()[:3], "little")


def announce_compilation(dispatcher: Any, what: str) -> None:
    """Log one notice per process if calling `dispatcher` is about to compile for the first time on this machine."""
    global _announced
    if _announced or dispatcher.signatures:
        return
    with _lock:
        folder = dispatcher._cache.cache_path  # None where nothing is kept
        name = dispatcher.py_func.__qualname__.rsplit(".", 1)[-1]
        if not _announced and not (folder and any(Path(folder).glob(f"*{name}*.nbi"))):
            log.warning(
                "compiling the %s kernels; this %s and takes about 20 s (cache: %s)",
                what,
                "happens once" if folder else "happens in every process",
                folder or "none",
            )
            _announced = True
