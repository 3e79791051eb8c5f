"""Rows X.tuned: recipes with the settings that `report tuning` found for X.

Every row got the same search, on scenes that no table has. A file `tuned.json` keeps what it found:

    {"X": {"settings": {"motion.lr_grid": 0.02, ...}, "trials": 24, "hours": 0.4, "budget": 0.25, "gain_db": 1.1,
           "scenes": ["van-10-small", ...], "commit": "..."}}
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.method import Recipe

SUFFIX = ".tuned"
Searches = dict[str, dict[str, Any]]  # by row


def is_tuned(name: str) -> bool:
    """Return whether a row's name is that of one with searched settings."""
    return name.endswith(SUFFIX)


def read_tuned(path: Path) -> Searches:
    """Return what a file of the package keeps of searches."""
    found: Searches = json.loads(path.read_text(encoding="utf-8"))
    return found


def tuned(recipes: Iterable[Recipe], searches: Searches) -> tuple[Recipe, ...]:
    """Return a recipe X.tuned for each of `recipes` that was searched."""
    return tuple(
        replace(r, name=f"{r.name}{SUFFIX}", settings={**r.settings, **searches[r.name]["settings"]})
        for r in recipes
        if r.name in searches
    )
