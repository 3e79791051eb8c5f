"""Arrays of .npz files: numpy's own are read as numpy reads them, others are refused before they take memory."""

from __future__ import annotations

import io
import pickle
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.untrusted import Expected, read_npz

WANTED = {"a": Expected("f", (None, 3)), "b": Expected("iu", (2,))}


def read(path: Path, optional: bool = False) -> dict[str, np.ndarray]:
    return read_npz(path, "two arrays", WANTED, "make them again", optional)


def npy(shape: str, kind: str, content: bytes = b"", size: int = 1) -> bytes:
    """A .npy file that states any shape and type."""
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + content * size


def archive(path: Path, a: bytes, compression: int = zipfile.ZIP_DEFLATED) -> Path:
    good = io.BytesIO()
    np.save(good, np.array([1, 2], np.uint8))
    with zipfile.ZipFile(path, "w", compression) as file:
        file.writestr("a.npy", a)
        file.writestr("b.npy", good.getvalue())
    return path


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_numpys_files_are_read_as_numpy_reads_them(tmp_path: Path, save: object) -> None:
    rng = np.random.default_rng(0)
    arrays = {"a": rng.random((5, 3)).astype(np.float32), "b": rng.integers(0, 9, 2), "more": np.zeros(3)}
    save(tmp_path / "x.npz", **arrays)  # type: ignore[operator]
    found = read(tmp_path / "x.npz")
    with np.load(tmp_path / "x.npz") as data:
        for name in ("a", "b"):
            np.testing.assert_array_equal(found[name], data[name], strict=True)
    assert set(found) == {"a", "b"} and set(read_npz(tmp_path / "x.npz", "arrays")) == {"a", "b", "more"}


def test_optional_arrays(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", b=np.arange(2))
    assert set(read(tmp_path / "x.npz", optional=True)) == {"b"}
    with pytest.raises(UserError, match="found damaged data.*a.npy"):
        read(tmp_path / "x.npz")


@pytest.mark.parametrize(
    ("a", "message"),
    [
        (npy("(10**15, 3)", "<f4"), "damaged data"),
        (npy("(1000000000000, 3)", "<f4"), "states 12000000000000 bytes and has"),
        (npy("(200, 3)", "<f4", bytes(12), 100), "states 2400 bytes and has"),
        (npy("(2, 4)", "<f4", bytes(32)), r"found a of shape \(2, 4\) and type float32"),
        (npy("(-2, 3)", "<f4", bytes(32)), r"found a of shape \(-2, 3\)"),
        (npy("(1, 3)", "<U4", bytes(48)), "type <U4"),
        (npy("(1, 3)", "|O", pickle.dumps([1])), "type object"),
        (npy("(1, 3", "<f4", bytes(12)), "damaged data"),
        (b"no array", "damaged data"),
        (b"", "damaged data"),
    ],
)
def test_arrays_that_are_others_are_refused_without_taking_memory(tmp_path: Path, a: bytes, message: str) -> None:
    path = archive(tmp_path / "x.npz", a)
    tracemalloc.start()
    with pytest.raises(UserError, match=message) as e:
        read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5e6 and "\n" not in str(e.value) and str(e.value).startswith(f"{path}: expected two arrays")


def test_a_small_archive_of_much_is_refused(tmp_path: Path) -> None:
    path = archive(tmp_path / "x.npz", npy("(50000000, 3)", "<f4", bytes(1_000_000), 600))
    assert path.stat().st_size < 1e6
    with pytest.raises(UserError, match="536870912 bytes at most, found 600000002"):
        read(path)


def test_other_packings_and_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="packed in another way"):
        read(archive(tmp_path / "x.npz", npy("(1, 3)", "<f4", bytes(12)), zipfile.ZIP_LZMA))
    (tmp_path / "y.npz").write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(UserError, match="damaged data"):
        read(tmp_path / "y.npz")
    with pytest.raises(UserError, match="no such file"):
        read(tmp_path / "none.npz")
