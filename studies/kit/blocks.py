"""Generated blocks of pages: what stands between `<!-- KIND: NAME -->`, or `<!-- KIND -->`, and `<!-- end KIND -->`."""

from __future__ import annotations

import re

KINDS = ("records", "searches", "realism", "noise")


def pattern(*kinds: str) -> re.Pattern[str]:
    """Return what matches a block of some kinds, with the groups `kind` and `name`."""
    kind = f"(?P<kind>{'|'.join(kinds)})"
    return re.compile(
        rf"^<!-- {kind}(?:: (?P<name>[a-z0-9-]+))? -->\n.*?^<!-- end (?P=kind) -->$", re.MULTILINE | re.DOTALL
    )
