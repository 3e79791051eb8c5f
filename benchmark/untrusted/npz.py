"""Arrays of `.npz` files, whose sizes and types are checked in their headers before any array is allocated."""

from __future__ import annotations

import math
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem

MOST_BYTES = 1 << 29  # of all arrays that are read from a file
_AGAIN = "restore the file or make it again"
_NUMBERS = "biufc"
_PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # as numpy writes


@dataclass(frozen=True)
class Expected:
    """The kinds of values that an array may have (numpy's letters: f, i, u), and its shape; None: any length."""

    kinds: str
    shape: tuple[int | None, ...]


def read_npz(
    path: Path, what: str, arrays: Mapping[str, Expected] | None = None, fix: str = _AGAIN, optional: bool = False
) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file by name: all of them, or `arrays`, with `optional` those of them that are there.

    `what` and `fix` are for the error. Raises UserError where the file is missing or damaged, or lacks one of the
    arrays, where one has another type or shape, and where they have more than MOST_BYTES. Nothing is unpickled.
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
            if total > MOST_BYTES:
                raise problem(path, f"{what}, {MOST_BYTES} bytes at most", f"{total}", fix)
            return {name: _array(file, name) for name in names}
    except FileNotFoundError:
        raise problem(path, what, "no such file", fix) from None
    except (
        zipfile.BadZipFile,
        zlib.error,
        LookupError,
        ValueError,
        TypeError,
        OverflowError,
        OSError,
        EOFError,
        RuntimeError,  # an encrypted member; NotImplementedError: one packed in another way
        SyntaxError,
        tokenize.TokenError,
    ) as e:
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
        found: NDArray[Any] = npy.read_array(f, allow_pickle=False)
    return found


def _fits(shape: tuple[int, ...], expected: tuple[int | None, ...]) -> bool:
    return len(shape) == len(expected) and all(e in (None, s) and s >= 0 for s, e in zip(shape, expected, strict=True))
