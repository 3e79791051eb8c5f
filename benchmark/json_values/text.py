"""JSON values as text and back: equal values have equal texts, and a text has one meaning for every reader."""

from __future__ import annotations

import json
import math
import re
from typing import Any

MOST_DEPTH = 64  # of nested JSON values; programs that walk along them need a depth for each
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


def json_text(value: Any) -> str:
    """Return the text of files of ours: equal values have equal texts. Raises ValueError for NaN and infinity."""
    return json.dumps(value, indent=2, sort_keys=True, allow_nan=False) + "\n"


def parse_json(text: str) -> Any:
    """Return the value of a JSON text.

    Raises ValueError for bad syntax, and for what other readers of the text may take in another way: a key twice in an
    object, numbers beyond 64 bits or double precision, NaN and infinity, half of a surrogate pair, and values nested
    more than MOST_DEPTH deep.
    """
    try:
        value = json.loads(
            text,
            object_pairs_hook=_object,
            parse_int=_integer,
            parse_float=_float,
            parse_constant=_refuse_constant,
        )
    except RecursionError:
        raise ValueError("values nested too deep") from None
    level = [value] if isinstance(value, dict | list) else []
    for _ in range(MOST_DEPTH):
        level = [v for c in level for v in (c.values() if isinstance(c, dict) else c) if isinstance(v, dict | list)]
        if not level:
            break
    else:
        raise ValueError(f"values nested more than {MOST_DEPTH} deep")
    if _SURROGATE.search(text):
        json.dumps(value, ensure_ascii=False).encode()
    return value


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"the key {twice[:80]!r} twice in an object")
    return found


def _integer(digits: str) -> int:
    if len(digits) > 20 or not -(2**63) <= (value := int(digits)) < 2**64:
        raise ValueError(f"an integer of {len(digits)} digits, which 64 bits do not hold")
    return value


def _float(digits: str) -> float:
    if not math.isfinite(value := float(digits)):
        raise ValueError(f"{digits[:20]} is too large for double precision")
    return value


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON number")
