"""Public names of a room that are imported when they are first used: importing a room stays instant."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
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
