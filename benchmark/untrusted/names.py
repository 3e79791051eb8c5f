"""Names that become parts of paths, and paths inside a folder.

The pattern of an id is `$defs/id` of common.schema.json: scenes, cameras and splits have one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.schemas import load_schema
from spike4dgs.benchmark.untrusted.numbers import shown

ID = "letters, digits, '.', '_' and '-', 100 at most, the first a letter or digit"


@cache
def _pattern(kind: str) -> re.Pattern[str]:
    return re.compile(load_schema("spike4dgs.benchmark", "common.schema.json")["$defs"][kind]["pattern"])


def is_id(name: str) -> bool:
    """Return whether a name may be that of a scene, a camera or a split.

    >>> is_id("car-0-small"), is_id("../car"), is_id("")
    (True, False, False)
    """
    return bool(_pattern("id").search(name))


def check_ids(names: Iterable[str], what: str, where: str | Path, fix: str = "rename it") -> None:
    """Raise UserError unless every name is an id, and no two differ in case alone; `what`: such as "camera".

    Names become files, and some file systems do not tell `Cam` from `cam`.
    """
    known: dict[str, str] = {}
    for name in names:
        if not is_id(name):
            raise problem(where, f"the id of a {what} ({ID})", shown(name), fix)
        if (other := known.setdefault(name.casefold(), name)) != name:
            raise problem(where, f"ids of {what}s that differ in more than case", f"{other} and {name}", fix)


def inside(root: Path, name: str, where: str | Path, fix: str = "restore the file") -> Path:
    """Return the path `name` below `root`. Raises UserError where it is absolute, has `..`, or is no plain path."""
    if not _pattern("path").search(name):
        raise problem(where, f"a path inside {root.name or root}", shown(name), fix)
    return root / name
