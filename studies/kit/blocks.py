"""Generated blocks of pages: what stands between `<!-- KIND: NAME -->`, or `<!-- KIND -->`, and `<!-- end KIND -->`."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_text

KINDS = ("records", "searches", "realism", "noise")


def pattern(*kinds: str) -> re.Pattern[str]:
    """Return what matches a block of some kinds, with the groups `kind` and `name`."""
    kind = f"(?P<kind>{'|'.join(kinds)})"
    return re.compile(
        rf"^<!-- {kind}(?:: (?P<name>[a-z0-9-]+))? -->\n.*?^<!-- end (?P=kind) -->$", re.MULTILINE | re.DOTALL
    )


def read_page(path: Path, kind: str) -> str:
    """Return the text of a page that has a block of a kind without names. Raises UserError where it is none."""
    fix = "correct --page, or add the two lines to the page"
    try:
        text = read_text(path, "a page")
    except UnicodeError:
        raise problem(path, "a page in UTF-8", "other bytes", fix) from None
    if not pattern(kind).search(text):
        raise problem(path, f"a block from <!-- {kind} --> to <!-- end {kind} -->", "none", fix)
    return text


def with_block(text: str, kind: str, lines: Iterable[str]) -> str:
    """Return the text of a page with these lines in its block of a kind without names."""
    block = "\n".join([f"<!-- {kind} -->", *lines, f"<!-- end {kind} -->"])
    return pattern(kind).sub(lambda _: block, text)


def table_rows(text: str, kind: str) -> list[str]:
    """Return the rows of the table in a page's block of a kind, without its two lines of head."""
    found = pattern(kind).search(text)
    return [line for line in found[0].splitlines() if line.startswith("| ")][2:] if found else []
