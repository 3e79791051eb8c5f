"""Numbers, names, tensors, arrays and YAML of files that come from others, and hostile files for every reader.

`SPIKE4DGS_HOSTILE=10000` gives the readers as many; a failure names the case, the number and what was done to it.
"""

import io
import os
import pickle
import struct
import subprocess
import sys
import zipfile
from pathlib import Path, PurePosixPath
from typing import Any

import hostile_files
import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given
from hypothesis import strategies as st
from memory import peak_bytes

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.untrusted import (
    MOST_HEADER_BYTES,
    MOST_YAML_BYTES,
    Expected,
    check_header,
    check_ids,
    inside,
    is_id,
    number,
    positive,
    read_npz,
    read_yaml,
    shown,
    whole,
)

INPUTS = int(os.environ.get("SPIKE4DGS_HOSTILE", "200"))


@pytest.mark.parametrize("value", [10**400, 1e308, float("inf"), float("nan"), True, None, "1", [1], -1, 10.5])
def test_what_is_no_number_of_a_range(value: Any) -> None:
    for read in (lambda: number(value, 0, 10), lambda: positive(value, 10), lambda: whole(value, 0, 10)):
        with pytest.raises(ValueError, match="is no number from 0 to 10"):
            read()


def test_numbers_of_a_range() -> None:
    assert number(3, 0, 10) == 3.0 and positive(0.5, 10) == 0.5
    assert whole(3, 0, 10) == whole(3.0, 0, 10) == 3 and isinstance(whole(3.0, 0, 10), int)
    with pytest.raises(ValueError, match="not positive"):
        positive(0, 10)
    with pytest.raises(ValueError, match="no whole number"):
        whole(3.5, 0, 10)


@given(st.integers(0, 2**63))
def test_whole_numbers_keep_every_digit(value: int) -> None:
    assert whole(value, 0, 2**63) == value


def test_any_value_can_be_shown() -> None:
    deep: list[Any] = []
    for _ in range(100_000):
        deep = [deep]
    assert shown(10**5000) == shown(deep) == "a value too large to print"
    assert shown("x" * 500).endswith("...") and len(shown("x" * 500)) == 60 and shown(1.5) == "1.5"


HOSTILE = ["", ".", "..", "../x", "a/b", "/a", "a\\b", "-o", ".a", "a b", "a\n", "a\0", "ä", "C:a", "a+b", "a@b"]


@pytest.mark.parametrize("name", [*HOSTILE, "x" * 101])
def test_names_that_are_no_ids(tmp_path: Path, name: str) -> None:
    assert not is_id(name)
    with pytest.raises(UserError, match="expected the id of a camera") as e:
        check_ids(["cam_00", name], "camera", tmp_path)
    assert "\n" not in str(e.value)


def test_names_that_are_ids_do_not_differ_in_case_alone() -> None:
    """They would be one file on some disks."""
    check_ids(["cam_00", "cam_00", "car-0-small", "views-3", "0", "x" * 100, "a..b", "car-500ms-lens"], "scene", "here")
    with pytest.raises(UserError, match="differ in more than case, found Cam_a and cam_a"):
        check_ids(["Cam_a", "cam_a"], "camera", "here")


@given(st.text(max_size=20))
def test_an_id_is_one_plain_component_of_a_path(name: str) -> None:
    if is_id(name):
        assert PurePosixPath("root", name).parts == ("root", name) and name.isascii() and name.isprintable()
        assert (Path("/root") / name).resolve() == Path("/root") / name


@given(st.text(alphabet="ab./\\:\0\n -", max_size=12))
def test_a_path_inside_a_folder_never_leaves_it(name: str) -> None:
    try:
        path = inside(Path("/root/folder"), name, "here")
    except UserError:
        return
    assert Path("/root/folder") in path.resolve().parents


def test_usual_paths_are_taken(tmp_path: Path) -> None:
    for name in ("spikes/cam_00.dat", "a b.dat", "rotation (1).dat", "-x", "a..b/c.d"):
        assert inside(tmp_path, name, "here") == tmp_path / name


def test_headers(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    safetensors.numpy.save_file({"a": np.zeros(3)}, path)
    check_header(path)
    path.write_bytes((MOST_HEADER_BYTES + 1).to_bytes(8, "little") + b"{}")
    with pytest.raises(ValueError, match=f"{MOST_HEADER_BYTES} at most"):
        check_header(path)
    with pytest.raises(OSError, match="no such file"):
        check_header(tmp_path)


WANTED = {"a": Expected("f", (None, 3)), "b": Expected("iu", (2,))}


def read(path: Path, optional: bool = False) -> dict[str, np.ndarray]:
    return read_npz(path, "two arrays", WANTED, "make them again", optional)


def npy(shape: str, kind: str, content: bytes = b"", size: int = 1) -> bytes:
    """A .npy file that states any shape and type."""
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + content * size


def archive(path: Path, a: bytes, compression: int = zipfile.ZIP_DEFLATED, stated: int | None = None) -> Path:
    """An archive of two arrays; its list states so many bytes of the first."""
    good = io.BytesIO()
    np.save(good, np.array([1, 2], np.uint8))
    with zipfile.ZipFile(path, "w", compression) as file:
        file.writestr("a.npy", a)
        file.writestr("b.npy", good.getvalue())
        file.getinfo("a.npy").file_size = len(a) if stated is None else stated
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

    def attempt() -> None:
        with pytest.raises(UserError, match=message) as e:
            read(path)
        assert "\n" not in str(e.value) and str(e.value).startswith(f"{path}: expected two arrays")

    assert peak_bytes(attempt) < 5e6


def test_a_small_archive_of_much_is_refused(tmp_path: Path) -> None:
    path = archive(tmp_path / "x.npz", npy("(50000000, 3)", "<f4", bytes(12)), stated=601_000_000)
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


BOMB = "a: &a [x, x, x]\n"
BOMB += "".join(f"{b}: &{b} [*{a}, *{a}, *{a}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True))


def test_plain_values(tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text("a: {b: [1, 2.5, text]}\nc: true\n")
    assert read_yaml(tmp_path / "x.yaml", "a file") == {"a": {"b": [1, 2.5, "text"]}, "c": True}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, "an alias"),
        ("a: &a {b: 1}\nc: {<<: *a}", "an alias"),
        ("[" * 5000, "nested too deep|expected"),
        ("a: [", "damaged text"),
        ("a: !!python/object/apply:os.system [echo]", "could not determine a constructor"),
        ("a: " + "9" * 5000, "damaged text"),
        ("a: 2001-99-99", "damaged text"),
        ("? [a]\n: 1", "unhashable"),
        ("a: 1\n" * MOST_YAML_BYTES, f"{MOST_YAML_BYTES} bytes at most"),
        (b"a: \xff", "damaged text"),
    ],
)
def test_texts_that_are_refused(tmp_path: Path, text: str | bytes, message: str) -> None:
    (tmp_path / "x.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UserError, match=message) as e:
        read_yaml(tmp_path / "x.yaml", "a file")
    assert "\n" not in str(e.value)


def test_readers_give_documented_errors_alone() -> None:
    """Errors in one line, little memory, nothing written elsewhere."""
    script = Path(hostile_files.__file__)
    command = [sys.executable, str(script), "--inputs", str(INPUTS), "--seed", "3"]
    done = _run(command)
    if done.returncode and "compiling" in done.stderr:  # that takes more memory than readers do: measure once more
        done = _run(command)
    assert done.returncode == 0, (done.stdout + done.stderr)[-6000:]
    assert f"{INPUTS} inputs in" in done.stdout and "0 failures" in done.stdout


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, timeout=600 + INPUTS)
