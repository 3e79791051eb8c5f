"""Generated blocks of pages: what stands between `<!-- KIND: NAME -->`, or `<!-- KIND -->`, and `<!-- end KIND -->`."""

from __future__ import annotations

import re
from collections.abc import Iterable

KINDS = ("records", "searches", "realism", "noise")


def pattern(*kinds: str) -> re.Pattern[str]:
    """Return what matches a block of some kinds, with the groups `kind` and `name`."""
    kind = f"(?P<kind>{'|'.join(kinds)})"
    return re.compile(
        rf"^<!-- {kind}(?:: (?P<name>[a-z0-9-]+))? -->\n.*?^<!-- end (?P=kind) -->$", re.MULTILINE | re.DOTALL
    )


def with_block(text: str, kind: str, lines: Iterable[str]) -> str:
    """Return the text of a page with these lines in its block of a kind without names."""
    block = "\n".join([f"<!-- {kind} -->", *lines, f"<!-- end {kind} -->"])
    return pattern(kind).sub(lambda _: block, text)


def table_rows(text: str, kind: str) -> list[str]:
    """Return the rows of the table in a page's block of a kind, without its two lines of head."""
    found = pattern(kind).search(text)
    return [line for line in found[0].splitlines() if line.startswith("| ")][2:] if found else []
