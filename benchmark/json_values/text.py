"""JSON values as text and back: equal values have equal texts, and a text has one meaning for every reader."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from functools import lru_cache
from json.encoder import encode_basestring_ascii
from typing import Any

MOST_DEPTH = 64  # of nested JSON values; programs that walk along them need a depth for each
_CONTAINERS = (dict, list, tuple)
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


def json_text(value: Any) -> str:
    """Return the text that `write_json` writes: equal values have equal texts.

    It is that of json.dumps with an indent of 2, which is written in Python; here objects and lists without others in
    them are left to its encoder in C.
    """
    return _indented(value, "\n") + "\n"


def _indented(value: Any, line: str) -> str:
    """Return a JSON value as text; `line` is a line break and the indent of the line that the value is in."""
    inner = line + "  "
    if not isinstance(value, _CONTAINERS) or not value:
        return encode_basestring_ascii(value) if type(value) is str else _encode(inner, value)
    if not _has_containers(value.values() if isinstance(value, dict) else value):
        text = _encode(inner, value)
        return f"{text[0]}{inner}{text[1:-1]}{line}{text[-1]}"
    if not isinstance(value, dict):
        return f"[{inner}{f',{inner}'.join(_indented(v, inner) for v in value)}{line}]"
    if not all(isinstance(key, str) for key in value):
        return json.dumps(value, indent=2, sort_keys=True, allow_nan=False).replace("\n", line)
    items = [f"{encode_basestring_ascii(key)}: {_indented(value[key], inner)}" for key in sorted(value)]
    return f"{{{inner}{f',{inner}'.join(items)}{line}}}"


def _has_containers(parts: Iterable[Any]) -> bool:
    for part in parts:
        if isinstance(part, _CONTAINERS):
            return True
    return False


def _encode(inner: str, value: Any) -> str:
    return _encoder(inner).encode(value)


@lru_cache(64)
def _encoder(inner: str) -> json.JSONEncoder:
    return json.JSONEncoder(sort_keys=True, allow_nan=False, separators=(f",{inner}", ": "))


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
