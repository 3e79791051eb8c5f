"""What is imported when it is first used: public names of a room, whose import stays instant, and pycolmap."""

from __future__ import annotations

import importlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any


def lazy_names(
    package: str, names: Mapping[str, tuple[str, ...]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` (PEP 562) of a package. `names`: module inside the package -> public names."""
    modules = {name: f"{package}.{module}" for module, of_module in names.items() for name in of_module}

    def getattribute(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        found = getattr(importlib.import_module(modules[name]), name)
        setattr(sys.modules[package], name, found)  # the next use finds it without this function
        return found

    return getattribute, lambda: sorted({*vars(sys.modules[package]), *modules})


@contextmanager
def kept_sigterm() -> Iterator[None]:
    """Put the handling of SIGTERM back after an import inside the context: pycolmap's prints a stack of C++ calls."""
    yield
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
