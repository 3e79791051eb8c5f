"""Bounded reading of files that come from others: numbers, names that become paths, tensors, arrays, YAML.

Names that become parts of paths, and paths inside a folder.

The pattern of an id is `$defs/id` of common.schema.json: scenes, cameras and splits have one.
"""

from __future__ import annotations

import math
import re
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.lib import format as npy
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_text
from spike4dgs.benchmark.schemas import load_schema

MAX_SIDE = 16384  # pixels of an image's width or height; cameras have a few hundred
MAX_TICKS = 10**12  # of a clip: more than a year at 20 kHz
MAX_HZ = 1e9  # ticks or frames per second
MAX_GAIN = 1e9  # spikes per tick of a pixel that sees white, and radiances
MAX_LENGTH = 1e9  # metres or pixels, of poses and intrinsics
_SHOWN = 60  # characters of a wrong value


def number(value: Any, low: float, high: float) -> float:
    """Return a finite number of [low, high] as float. Raises ValueError for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{shown(value)} is no number from {low:g} to {high:g}")
    return float(value)


def positive(value: Any, high: float) -> float:
    """Return a number of (0, high] as float. Raises ValueError for anything else."""
    if (found := number(value, 0.0, high)) == 0:
        raise ValueError(f"{shown(value)} is not positive")
    return found


def whole(value: Any, low: int, high: int) -> int:
    """Return an integer of [low, high]; 3.0 is one. Raises ValueError for anything else."""
    if not (found := number(value, low, high)).is_integer():
        raise ValueError(f"{shown(value)} is no whole number")
    return value if isinstance(value, int) else int(found)


def shown(value: object) -> str:
    """Return a value in the form of an error message, cut where it is long."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # more digits than Python prints, or absurd depth
        text = "a value too large to print"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


ID = "letters, digits, '.', '_' and '-', 100 at most, the first a letter or digit"


@cache
def _pattern(kind: str) -> re.Pattern[str]:
    return re.compile(load_schema("spike4dgs.benchmark", "common.schema.json")["$defs"][kind]["pattern"])


def matches(kind: str, text: str) -> bool:
    """Return whether a text has the form of `$defs/KIND` of common.schema.json: id, method, path, ..."""
    return bool(_pattern(kind).search(text))


def is_id(name: str) -> bool:
    """Return whether a name may be that of a scene, a camera or a split.

    >>> is_id("car-0-small"), is_id("../car"), is_id("")
    (True, False, False)
    """
    return matches("id", name)


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


def inside(root: Path, name: str, where: str | Path) -> Path:
    """Return the path `name` below `root`. Raises UserError where it is absolute, has `..`, or is no plain path."""
    if not matches("path", name):
        raise problem(where, f"a path inside {root.name or root}", shown(name), "restore the file")
    return root / name


MOST_HEADER_BYTES = 16 << 20  # a model of many pieces has some kB


def check_header(path: Path) -> None:
    """Raise ValueError for a header of more than MOST_HEADER_BYTES, and OSError where the file cannot be read."""
    if not path.is_file():
        raise OSError("no such file")
    with open(path, "rb") as file:
        if (size := int.from_bytes(file.read(8), "little")) > MOST_HEADER_BYTES:
            raise ValueError(f"a header of {size} bytes; {MOST_HEADER_BYTES} at most are read")


MOST_ARRAY_BYTES = 1 << 29  # of all arrays that are read from a file
_AGAIN = "restore the file or make it again"
_NUMBERS = "biufc"
_PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # as numpy writes
_BROKEN = (zipfile.BadZipFile, zlib.error, LookupError, ValueError, TypeError, OverflowError, OSError, EOFError)
_ODD = (RuntimeError, SyntaxError, tokenize.TokenError)  # such as an encrypted member, or one packed in another way


@dataclass(frozen=True)
class Expected:
    """The kinds of values that an array may have (numpy's letters: f, i, u), and its shape; None: any length."""

    kinds: str
    shape: tuple[int | None, ...]


def read_npz(
    path: Path,
    what: str,
    arrays: Mapping[str, Expected] | None = None,
    fix: str = _AGAIN,
    optional: bool = False,
    most_bytes: int = MOST_ARRAY_BYTES,
) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file by name: all of them, or `arrays`, with `optional` those of them that are there.

    `what` and `fix` are for the error. Raises UserError where the file is missing or damaged, or lacks one of the
    arrays, where one has another type or shape, and where they have more than `most_bytes`. Nothing is unpickled.
    """
    try:
        with zipfile.ZipFile(path) as file:
            there = [name.removesuffix(".npy") for name in file.namelist()]
            names = there if arrays is None else [name for name in arrays if not optional or name in there]
            total = 0
            for name in names:
                shape, dtype = _header(file, name)
                expected = Expected(_NUMBERS, (None,) * len(shape)) if arrays is None else arrays[name]
                if dtype.hasobject or dtype.kind not in expected.kinds or not _fits(shape, expected.shape):
                    raise problem(path, what, f"{name} of shape {shape} and type {dtype}"[:200], fix)
                total += math.prod((*shape, dtype.itemsize))
            if total > most_bytes:
                raise problem(path, f"{what}, {most_bytes} bytes at most", f"{total}", fix)
            return {name: _array(file, name) for name in names}
    except FileNotFoundError:
        raise problem(path, what, "no such file", fix) from None
    except (*_BROKEN, *_ODD) as e:
        raise problem(path, what, f"damaged data ({str(e)[:200]})", fix) from None


def _header(file: zipfile.ZipFile, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return the shape and type of an array. Raises ValueError where its bytes are fewer than they need."""
    member = file.getinfo(f"{name}.npy")
    if member.compress_type not in _PACKED:
        raise ValueError(f"{name} is packed in another way than numpy packs arrays")
    with file.open(member) as f:
        read = npy.read_array_header_1_0 if npy.read_magic(f) == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = read(f)
    if (stated := math.prod((*shape, dtype.itemsize))) > member.file_size:
        raise ValueError(f"{name} states {stated} bytes and has {member.file_size}")
    return shape, dtype


def _array(file: zipfile.ZipFile, name: str) -> NDArray[Any]:
    with file.open(f"{name}.npy") as f:
        return np.asarray(npy.read_array(f, allow_pickle=False))


def _fits(shape: tuple[int, ...], expected: tuple[int | None, ...]) -> bool:
    return len(shape) == len(expected) and all(e in (None, s) and s >= 0 for s, e in zip(shape, expected, strict=True))


MOST_YAML_BYTES = 1 << 16  # a camera takes some hundred; the parser reads some 30 kB a second


def read_yaml(path: Path, what: str) -> Any:
    """Return the value of a YAML file. `what` names the kind of file for the error.

    Raises UserError where the file is missing or too large, where it is no YAML, and where it has aliases.
    """
    try:
        return parse_yaml(read_text(path, what, MOST_YAML_BYTES))
    except ValueError as e:
        raise problem(path, f"{what} (YAML)", f"damaged text ({e})", "restore the file") from None


def parse_yaml(text: str, maps: Collection[str] = ()) -> Any:
    """Return the value of a YAML text; maps with a tag among `maps` are plain ones.

    Raises ValueError for bad syntax, aliases, other tags and values nested too deep.
    """

    class Loader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
        """A safe loader without aliases: a few of them can stand for more values than memory holds."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise yaml.YAMLError("an alias, such as *name")
            node = super().compose_node(parent, index)
            if node.tag in maps and isinstance(node, yaml.MappingNode):
                node.tag = "tag:yaml.org,2002:map"
            return node

    try:
        return yaml.load(text, Loader)
    except RecursionError:
        raise ValueError("values nested too deep") from None
    except (yaml.YAMLError, ValueError, OverflowError, LookupError, TypeError, AttributeError) as e:
        raise ValueError(str(e)[:200]) from None


def printable(text: str) -> str:
    """Return a text, such as a file's name, with all that no terminal shows and no JSON file holds written out."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
