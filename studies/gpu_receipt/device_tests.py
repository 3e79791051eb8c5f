"""The tests of the device, run in a process for themselves and counted."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from spike4dgs.studies.kit.checkout import pytest_options

_TESTS_S = 1200  # for all of them, before they are ended


def run_tests(root: Path, tests: str) -> dict[str, Any]:
    """Run tests of a checkout and return the outcome.

    They have a process to themselves, which a fault may end, and each kernel is waited for, so that a fault is its own.
    """
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        command = [sys.executable, "-m", "pytest", *pytest_options(root), f"--junitxml={report}", str(root / tests)]
        environ = {**os.environ, "CUDA_LAUNCH_BLOCKING": "1"}
        try:
            code = subprocess.run(command, cwd=root, env=environ, capture_output=True, timeout=_TESTS_S).returncode
        except subprocess.TimeoutExpired:
            code = None
        cases = [] if not report.is_file() else list(ElementTree.parse(report).iter("testcase"))
    bad = [(case, fault) for case in cases for fault in case if fault.tag in ("failure", "error")]
    skipped = sum(case.find("skipped") is not None for case in cases)
    return {
        "exit_code": code,
        "passed": len(cases) - len(bad) - skipped,
        "failed": len(bad),
        "skipped": skipped,
        "seconds": time.monotonic() - start,
        "failures": [{"test": case.get("name"), "message": _line(fault.get("message"))} for case, fault in bad],
    }


def _line(text: str | None) -> str:
    """Return the first line of a message, without folders."""
    return re.sub(r"(/[\w.-]+)+/", "", (text or "").partition("\n")[0])[:300]


def passed(tests: dict[str, Any]) -> bool:
    """Return whether tests ran, and all of them well."""
    return tests["exit_code"] == 0 and tests["passed"] > 0


def counted(tests: dict[str, Any]) -> str:
    """Return an outcome in a line."""
    counts = f"{tests['passed']} passed, {tests['failed']} failed, {tests['skipped']} skipped"
    return counts if tests["exit_code"] in (0, 1) else f"{counts}; ended with exit code {tests['exit_code']}"
