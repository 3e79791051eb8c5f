"""Fixtures of all tests. Helper modules lie in `tests/support`, which pytest puts on the path."""

import gc
import os

import spike4dgs.benchmark  # noqa: F401  before NumPy and torch: it says how OpenMP waits, and OpenBLAS's kernels

# Workers share the cores: of two threads on a busy core one waits for the other at every step of an optimiser.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    gc.disable()  # until the tests are collected

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from devtools import Page, browser
from filelock import FileLock
from full_scene import write_full_scene
from hard_case import hard_case  # noqa: F401
from small_scenes import write_small_scene

# A loss of power is no test's matter, and the disk takes milliseconds for each of many thousand files. A file that is
# closed is still an error.
os.fsync = os.fdatasync = lambda fd: os.fstat(fd) and None


def pytest_collection_finish() -> None:
    """Modules and tests stay: the collector of garbage, which takes half a second to look through them, need not.

    What tests leave behind is looked through once in a while, not after every few hundred new objects.
    """
    gc.freeze()
    gc.set_threshold(20_000, 10, 10)
    gc.enable()


@pytest.fixture(scope="session")
def one_small_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_scene(tmp_path_factory.mktemp("small") / "scene")


@pytest.fixture
def small_scene(one_small_scene: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(one_small_scene, tmp_path / "scene"))


@pytest.fixture(scope="session")
def one_full_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_full_scene(tmp_path_factory.mktemp("full") / "scene")


@pytest.fixture
def full_scene(one_full_scene: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(one_full_scene, tmp_path / "scene"))


@pytest.fixture
def no_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """No sheets, videos and scatter of `run-benchmark`, which take four fifths of the time of a small run."""
    monkeypatch.setattr("spike4dgs.benchmark.reports.benchmark._write_images", lambda *_: [])


@pytest.fixture(scope="session")
def one_browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture
def empty_page(one_browser: Page) -> Page:
    """The empty page of a browser that other tests have used, without what they set."""
    one_browser.call("Emulation.setEmulatedMedia", features=[])
    one_browser.show("about:blank", "document.readyState == 'complete'")
    one_browser.forget()
    return one_browser


@pytest.fixture(scope="session")
def tiny_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with car-0-tiny, rendered by Mitsuba in one process of its own, and its report with the audit.

    All workers share it: the first that asks for it makes it.
    """
    root = tmp_path_factory.getbasetemp()
    out = (root.parent if "PYTEST_XDIST_WORKER" in os.environ else root) / "tiny"
    code = "import sys; from spike4dgs.cli import main; sys.exit(main(sys.argv[1:]))"
    command = ["make-dataset", "car", "--profile", "tiny", "--out", str(out), "--audit"]
    with FileLock(out.with_suffix(".lock")):
        if not (out / "done").exists():
            done = subprocess.run([sys.executable, "-c", code, *command], capture_output=True, text=True, timeout=900)
            assert done.returncode == 0, done.stdout + done.stderr
            (out / "done").touch()
    return out
