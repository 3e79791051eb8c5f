"""The code that a report runs: its digest, and the tests of a checkout."""

from __future__ import annotations

import sys
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from spike4dgs import baselines, benchmark, generators, method
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.runs.method_code import sources_sha256


@cache
def code_now() -> str:
    """Return a digest of all that a study runs: a commit tells of no edits, and an installation has none."""
    return sources_sha256([baselines, benchmark, generators, method, sys.modules[__name__.rpartition(".kit.")[0]]])


def find_checkout(command: str) -> Path:
    """Return the root of the checkout whose tests `command` runs: the present folder, or that of this source."""
    for root in (Path.cwd(), Path(__file__).parents[2]):
        if (root / "tests" / "support" / "hard_case.py").is_file():
            if find_spec("pytest") is None:
                raise problem(command, "pytest", "none", 'run `pip install -e ".[test]"` in the checkout')
            return root
    do = 'clone the repository, run `pip install -e ".[test]"` there, and repeat the command in its folder'
    raise problem(command, "a checkout with its tests", f"none in {Path.cwd()}", do)


def pytest_options(root: Path) -> list[str]:
    """Return the options of pytest that run tests of a checkout in one process, where a warning is no error."""
    options = ["-q", "--tb=short", "-p", "no:cacheprovider", "-p", "no:xdist", "-o", "addopts="]
    options += ["--import-mode=importlib", "--strict-markers", "-c", str(root / "pyproject.toml")]
    return [*options, "-W", "default", "-W", "ignore::DeprecationWarning", "-W", "ignore::PendingDeprecationWarning"]
