"""Compilation by numba with the machine code kept in the user's cache folder, never beside the sources.

Files that numba leaves in an installed package outlive the package, and the folder that they keep alive then hides
another install. The folder here is named by this package's version, and numba names a folder in it by the path of the
sources: no install takes code from another. numba compiles a kernel anew where its own file changes, but a kernel has
the code and the constants of other files in it; so a digest of these names a folder too.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import cache, update_wrapper
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
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
                # No way in from C, which nothing takes and which would be compiled too.
                self._compiled = cached_jit(numba.njit, no_cfunc_wrapper=True, **self._options)(self._function)
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
            before, base = config.CACHE_DIR, config.CACHE_DIR or _folder()
            config.CACHE_DIR = folder = os.path.join(base, _digest_of(function, options))
            try:
                return jit(cache=_is_writable(folder), **options)(function)
            finally:
                config.CACHE_DIR = before

    return decorate


def _digest_of(function: Callable[..., Any], options: Mapping[str, Any]) -> str:
    """Return the digest of a kernel's parts and of the compiler's options, which may come from another file."""
    texts = [f"{k}={sorted(v) if isinstance(v, set) else v!r}" for k, v in sorted(options.items())]
    return hashlib.sha256(" ".join([parts_digest(function), *texts]).encode()).hexdigest()[:12]


def parts_digest(function: Callable[..., Any]) -> str:
    """Return a digest of a function, of the functions that it calls, by name and code, and of the constants they name.

    Constants are numbers, texts, tuples and arrays in the functions' modules, in other modules of this package that
    they name, and in closures. Of an intrinsic, which writes code by classes and nested functions, the whole source of
    its module counts, and of those that this one takes functions and classes from.
    """
    digest, seen, modules = hashlib.sha256(), set[FunctionType](), set[str]()

    def add(value: Any) -> None:
        if isinstance(value, _Deferred):
            value = value._function
        value = getattr(value, "py_func", value)  # of numba's dispatchers
        if isinstance(value, FunctionType):
            if value not in seen:
                seen.add(value)
                digest.update(f"{value.__qualname__} {_instructions(value.__code__)!r}".encode())
                for part in _parts(value):
                    add(part)
        elif isinstance(intrinsic := getattr(value, "_defn", None), FunctionType):
            for source in _sources(sys.modules[intrinsic.__module__], modules):
                digest.update(source)
        elif isinstance(value, bool | int | float | str | bytes | tuple):
            digest.update(repr(value).encode())
        elif hasattr(value, "tobytes"):
            digest.update(value.tobytes())

    add(function)
    return digest.hexdigest()[:12]


def _instructions(code: CodeType) -> tuple[Any, ...]:
    constants = [_instructions(c) if isinstance(c, CodeType) else repr(c) for c in code.co_consts]
    return code.co_code, code.co_names, code.co_varnames, code.co_freevars, constants


def _parts(function: FunctionType) -> list[Any]:
    """Return what the names of a function stand for, the functions of this package and constants among it."""
    code, known = function.__code__, function.__globals__
    modules = [v for n in code.co_names if isinstance(v := known.get(n), ModuleType)]
    modules = [m for m in modules if m.__name__.partition(".")[0] == __name__.partition(".")[0]]
    found = [known[n] for n in code.co_names if n in known]
    found += [vars(m)[n] for m in modules for n in code.co_names if n in vars(m)]
    return found + [cell.cell_contents for cell in function.__closure__ or ()]


def _sources(module: ModuleType, seen: set[str]) -> Iterator[bytes]:
    """Yield the source of a module, and of those of its package that it has functions and classes of."""
    if module.__name__ in seen or not module.__file__:
        return
    seen.add(module.__name__)
    yield Path(module.__file__).read_bytes()
    package = module.__name__.partition(".")[0]
    names = (getattr(v, "__name__" if isinstance(v, ModuleType) else "__module__", None) for v in vars(module).values())
    for name in dict.fromkeys(n for n in names if isinstance(n, str) and n.partition(".")[0] == package):
        if name in sys.modules:
            yield from _sources(sys.modules[name], seen)


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
