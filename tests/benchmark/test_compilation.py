"""Compiled code is kept in the user's cache folder, one folder an install, and never beside the sources."""

import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

import spike4dgs.benchmark
from spike4dgs.benchmark.compilation import cached_njit, parts_digest
from spike4dgs.benchmark.files import user_cache
from spike4dgs.method.motion import hexplane_cpu, mlp_cpu
from spike4dgs.method.splat.kernels import vector_ir

TWICE = """
from spike4dgs.benchmark.compilation import cached_njit

@cached_njit(nogil=True)
def twice(x):
    return 2 * x
"""
CALL = """
from spike4dgs.benchmark import twice
assert twice.__file__.startswith(FOLDER), twice.__file__
assert twice.twice(4) == 8
"""


@pytest.fixture
def install(tmp_path: Path) -> Path:
    """A copy of the package with a kernel in the room `benchmark` alone, as an install of its own."""
    source, room = Path(spike4dgs.benchmark.__file__).parent, tmp_path / "first/spike4dgs/benchmark"
    shutil.copytree(source, room, ignore=shutil.ignore_patterns("__pycache__"))
    (room / "twice.py").write_text(TWICE)
    shutil.copy(str(spike4dgs.__file__), tmp_path / "first/spike4dgs/__init__.py")
    return tmp_path / "first"


def call_in(install: Path, **variables: str) -> None:
    """Call a kernel of an install in a process of its own."""
    kept = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    code = CALL.replace("FOLDER", repr(str(install)))
    command = [sys.executable, "-P", "-c", code]
    done = subprocess.run(command, env=kept | {"PYTHONPATH": str(install)} | variables, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def compiled(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.nb[ic]"))


def test_nothing_lands_beside_the_sources_and_two_installs_share_nothing(install: Path, tmp_path: Path) -> None:
    """The second also finds no folder to write to at first, and keeps nothing then."""
    second = shutil.copytree(install, tmp_path / "second")
    cache = tmp_path / "cache"
    call_in(install, XDG_CACHE_HOME=str(cache))
    first = compiled(cache / "spike4dgs/numba")
    (tmp_path / "file").touch()
    call_in(second, XDG_CACHE_HOME=str(tmp_path / "file"))
    assert first and compiled(tmp_path) == first
    call_in(second, XDG_CACHE_HOME=str(cache))
    both = compiled(cache / "spike4dgs/numba")
    assert len(both) == 2 * len(first) and compiled(tmp_path) == both


KERNEL = """
from spike4dgs.benchmark.compilation import cached_njit
from parts_of_kernel import SCALE, plus

@cached_njit(nogil=True)
def kernel(x):
    return plus(SCALE * x)
"""
PARTS = """
from spike4dgs.benchmark.compilation import cached_njit
SCALE = 2
_ADDED = 1

@cached_njit(nogil=True)
def plus(x):
    return x + _ADDED
"""


@pytest.fixture
def kernel_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to import kernel_of_parts.py from, with a cache of machine code in it."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "kernel_of_parts.py").write_text(KERNEL)
    return tmp_path


def test_numbas_variable_goes_before(kernel_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """numba takes its setting from NUMBA_CACHE_DIR when it is imported."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(kernel_folder / "users"))
    changed_parts(kernel_folder, [PARTS])
    assert compiled(kernel_folder) == compiled(kernel_folder / "cache") != []


def changed_parts(folder: Path, texts: list[str]) -> tuple[list[int], list[int]]:
    """Return kernel(10) of kernel_of_parts.py with each text of parts_of_kernel.py, and the machine codes kept then."""
    found, counts = [], []
    for text in texts:
        (folder / "parts_of_kernel.py").write_text(text)
        for name in ("kernel_of_parts", "parts_of_kernel"):
            sys.modules.pop(name, None)
        shutil.rmtree(folder / "__pycache__", ignore_errors=True)  # its times have whole seconds
        importlib.invalidate_caches()
        found.append(importlib.import_module("kernel_of_parts").kernel(10))
        counts.append(len(list((folder / "cache").rglob("kernel_of_parts*.nbc"))))
    return found, counts


def test_a_kernel_is_compiled_anew_where_another_file_changes_what_is_in_it(kernel_folder: Path) -> None:
    """numba itself looks at the kernel's file alone, and would go on with the machine code of the first."""
    texts = [PARTS, PARTS.replace("SCALE = 2", "SCALE = 7"), PARTS.replace("_ADDED = 1", "_ADDED = 30"), PARTS]
    found, counts = changed_parts(kernel_folder, texts)
    assert found == [21, 71, 50, 21] and counts == [1, 2, 3, 3], "the last is the first one's"


def test_a_kernel_is_compiled_anew_where_another_file_changes_the_compilers_options(kernel_folder: Path) -> None:
    """Of a division by zero numba's own error model makes an error, and NumPy's an infinity."""
    text = KERNEL.replace("SCALE, plus", "OPTIONS, SCALE").replace("(nogil=True)", "(**OPTIONS)")
    (kernel_folder / "kernel_of_parts.py").write_text(text.replace("plus(SCALE * x)", "SCALE / (x - x)"))
    texts = [PARTS + f"OPTIONS = dict(error_model={model!r})" for model in ("numpy", "python")]
    assert changed_parts(kernel_folder, texts[:1])[0] == [np.inf]
    with pytest.raises(ZeroDivisionError):
        changed_parts(kernel_folder, texts[1:])


INTRINSIC = """
from numba import types
from numba.extending import intrinsic
SCALE = 2

class Code:
    def sum(self, builder, x):
        return builder.add(x, x.type(1))

@intrinsic
def plus(typing, x):
    def write(context, builder, signature, arguments):
        return Code().sum(builder, arguments[0])

    return types.int64(types.int64), write
"""


def test_a_kernel_is_compiled_anew_where_an_intrinsic_writes_other_code(kernel_folder: Path) -> None:
    found, counts = changed_parts(kernel_folder, [INTRINSIC, INTRINSIC.replace("type(1)", "type(5)"), INTRINSIC])
    assert found == [21, 25, 21] and counts == [1, 2, 2]


@pytest.mark.parametrize("kernel", [hexplane_cpu._forward, mlp_cpu._forward], ids=["hexplane", "mlp"])
def test_kernels_depend_on_their_vectors_file(kernel: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = parts_digest(kernel._function)
    assert parts_digest(kernel._function) == before
    changed = tmp_path / "vector_ir.py"
    changed.write_text(Path(vector_ir.__file__).read_text() + "# changed")
    monkeypatch.setattr(vector_ir, "__file__", str(changed))
    assert parts_digest(kernel._function) != before


def test_other_packages_keep_numbas_own_folder() -> None:
    before = numba.config.CACHE_DIR
    double = cached_njit(nogil=True)(lambda x: 2 * x)
    assert double(4) == 8 and numba.config.CACHE_DIR == before


def test_the_users_cache_folder_follows_the_standard(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert user_cache() == tmp_path / "spike4dgs"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert user_cache() == tmp_path / "home/.cache/spike4dgs"
