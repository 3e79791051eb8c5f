"""TOML tables, read key by key: any error becomes one UserError that names file, key, found value and fix."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import read_text
from spike4dgs.benchmark.untrusted import shown

T = TypeVar("T")
D = TypeVar("D")
_MOST_BYTES = 1 << 18  # a profile of nine cameras has 5 kB


@dataclass(frozen=True)
class Kind(Generic[T]):
    """A kind of value: its name in messages, and its reader (ValueError or TypeError for values of another kind)."""

    expected: str
    read: Callable[[Any], T]


def values(expected: str, fits: Callable[[Any], object], read: Callable[[Any], T] = lambda value: value) -> Kind[T]:
    """Return the kind of the values that `fits` accepts, as `read` converts them."""

    def checked(value: Any) -> T:
        if not fits(value):
            raise ValueError
        return read(value)

    return Kind(expected, checked)


def whole(low: int, high: int) -> Kind[int]:
    """Return the kind of integers of [low, high]."""
    return values(f"a whole number from {low} to {high}", lambda v: type(v) is int and low <= v <= high)


def number(low: float, high: float, expected: str) -> Kind[float]:
    """Return the kind of finite numbers of (low, high]."""
    return values(expected, lambda v: type(v) in (int, float) and math.isfinite(v) and low < v <= high, float)


def choice(*names: str) -> Kind[str]:
    """Return the kind of these words."""
    return values(f"one of {', '.join(names)}", lambda v: v in names)


def matching(expected: str, fits: Callable[[str], object]) -> Kind[str]:
    """Return the kind of strings that `fits` accepts."""
    return values(expected, lambda v: isinstance(v, str) and fits(v))


def tuple_of(kind: Kind[T], expected: str) -> Kind[tuple[T, ...]]:
    """Return the kind of lists of values of one kind."""
    return values(expected, lambda v: isinstance(v, list), lambda v: tuple(map(kind.read, v)))


FLAG: Kind[bool] = values("true or false", lambda v: isinstance(v, bool))
TEXT = matching("a text that is not empty", str.strip)


class Table:
    """A table of a TOML file. Each key is taken once; `close` refuses the keys that were not."""

    def __init__(self, path: Path, name: str, values: dict[str, Any]) -> None:
        self.path, self._name, self._left, self._known = path, name, dict(values), set[str]()

    def error(self, key: str, expected: str, found: str, fix: str = "correct the file") -> UserError:
        """Return the error for a key of this table."""
        name = f"{self._name}.{key}" if self._name and key else self._name or key
        return problem(f"{self.path}, key {name}", expected, found, fix)

    def take(self, key: str, kind: Kind[T]) -> T:
        """Return the value of a required key."""
        if key not in self._left:
            raise self.error(key, kind.expected, "no such key", "add it")
        return self.get(key, kind, None)  # type: ignore[return-value]

    def get(self, key: str, kind: Kind[T], default: D) -> T | D:
        """Return the value of an optional key."""
        self._known.add(key)
        if key not in self._left:
            return default
        value = self._left.pop(key)
        try:
            return kind.read(value)
        except (TypeError, ValueError, OverflowError):
            raise self.error(key, kind.expected, shown(value)) from None

    def fields(self, kinds: Mapping[str, Kind[Any]], required: Collection[str]) -> dict[str, Any]:
        """Return the values of the keys that are there, for fields of these names; `required` keys must be."""
        self._known.update(kinds)
        return {key: self.take(key, kind) for key, kind in kinds.items() if key in self._left or key in required}

    def tables(self, key: str) -> list[Table]:
        """Return the tables of an array of tables, [[key]]."""
        are_tables: Kind[list[dict[str, Any]]] = values(
            f"tables [[{key}]]", lambda v: isinstance(v, list) and all(isinstance(t, dict) for t in v)
        )
        found: list[dict[str, Any]] | None = self.get(key, are_tables, None)
        return [Table(self.path, f"{key}[{i}]", v) for i, v in enumerate(found or [])]

    def table(self, key: str) -> Table | None:
        """Return a table in this one, or None where it is absent."""
        found = self.get(key, values(f"a table [{key}]", lambda v: isinstance(v, dict)), None)
        return None if found is None else Table(self.path, f"{self._name}.{key}".lstrip("."), found)

    def items(self) -> list[tuple[str, Table]]:
        """Take all remaining keys, each a table, and return them by name."""
        return [(key, self.table(key)) for key in list(self._left)]  # type: ignore[misc]

    def with_defaults(self, values: dict[str, Any]) -> Table:
        """Return this table with values for its absent keys."""
        return Table(self.path, self._name, {**values, **self._left})

    def rest(self) -> dict[str, Any]:
        """Take all remaining keys and return them."""
        rest, self._left = self._left, {}
        return rest

    def close(self) -> None:
        """Raise UserError for a key that was not taken."""
        if self._left:
            raise self.error(next(iter(self._left)), f"keys among {', '.join(sorted(self._known))}", "another key")


def read_toml(path: Path, what: str) -> Table:
    """Read a TOML file. `what` names the kind of file for the error: missing, unreadable, or no TOML."""
    try:
        return Table(path, "", tomllib.loads(read_text(path, what, _MOST_BYTES)))
    except RecursionError:
        raise problem(path, f"{what} (TOML)", "values nested too deep", "correct the file") from None
    except ValueError as e:  # bad syntax, bad UTF-8
        raise problem(path, f"{what} (TOML)", f"damaged text ({str(e)[:200]})", "correct the file") from None
