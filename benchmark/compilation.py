"""Compilation by numba with the machine code kept in the user's cache folder, never beside the sources.

Files that numba leaves in an installed package outlive the package, and the folder that they keep alive then hides
another install. The folder here is named by this package's version, and numba names a folder in it by the path of the
sources: no install takes code from another.
"""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Callable
from functools import cache, update_wrapper
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from spike4dgs.benchmark.files import user_cache

_lock = threading.Lock()
_deferred = threading.Lock()


def cached_njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles for the CPU, see `cached_jit`; numba is imported on the first call."""
    return lambda function: _Deferred(function, options)


class _Deferred:
    """A function that numba gets on its first use, by a call or by another kernel: its import takes 0.2 s."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        update_wrapper(self, function)
        self._function, self._options, self._compiled = function, options, None

    def __call__(self, *arguments: Any) -> Any:
        return (self._compiled or self._compile())(*arguments)

    def __getattr__(self, name: str) -> Any:
        """Return what numba's dispatcher has, such as `_numba_type_`, by which kernels call each other."""
        if name.startswith("__"):  # what copying and inspection ask for
            raise AttributeError(name)
        return getattr(self._compiled or self._compile(), name)

    def _compile(self) -> Any:
        import numba

        with _deferred:
            if self._compiled is None:
                self._compiled = cached_jit(numba.njit, **self._options)(self._function)
        return self._compiled


def cached_jit(jit: Callable[..., Any], **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles on the first call, with these options of `jit`, and keeps the machine code.

    `jit` is numba.njit or numba.cuda.jit. NUMBA_CACHE_DIR goes before the user's cache folder. Where the folder cannot
    be written to, nothing is kept.
    """

    from numba.core import config as numba_config

    config: Any = numba_config  # its names are made from environment variables

    def decorate(function: Callable[..., Any]) -> Any:
        with _lock:  # the setting belongs to numba: another package must not see it
            before, folder = config.CACHE_DIR, config.CACHE_DIR or _folder()
            config.CACHE_DIR = folder
            try:
                return jit(cache=_is_writable(folder), **options)(function)
            finally:
                config.CACHE_DIR = before

    return decorate


def _folder() -> str:
    try:
        found = version("spike4dgs")
    except PackageNotFoundError:  # the sources alone
        found = "sources"
    return str(user_cache() / "numba" / found)


@cache
def _is_writable(folder: str) -> bool:
    try:
        os.makedirs(folder, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True
