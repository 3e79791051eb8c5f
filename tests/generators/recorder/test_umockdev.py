"""The recorder on libusb itself: real queued transfers, on devices that libumockdev substitutes for the kernel's.

/dev and /sys are mocked for a whole process, so that the cases, which `usb_cases.py` holds, run in one of their own.
"""

from __future__ import annotations

import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
import usb_cases
from usb_testbed import LIBRARIES, PRELOAD

CASES = sorted(name for name in vars(usb_cases) if name.startswith("test_"))

_TIME_LIMIT_S = 1800  # for a busy machine


def _environment() -> dict[str, str]:
    return os.environ | {"LD_PRELOAD": PRELOAD}


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Name of a case -> the failure of each of its runs, "" where it passed."""
    load = f"import ctypes\nfor name in {LIBRARIES}: ctypes.CDLL(name)"
    loaded = subprocess.run([sys.executable, "-c", load], env=_environment(), capture_output=True, text=True)
    if loaded.returncode:
        reason = loaded.stderr.strip().splitlines()[-1]
        pytest.skip(f"the Debian packages umockdev and libusb-1.0-0 are not here ({reason})")
    folder = tmp_path_factory.mktemp("umockdev")
    command = [
        sys.executable,
        "-m",
        "pytest",
        "--numprocesses=0",
        "-p",
        "no:cacheprovider",
        f"--junitxml={folder / 'cases.xml'}",
    ]
    command += [f"--basetemp={folder / 'work'}", str(Path(usb_cases.__file__))]
    done = subprocess.run(command, env=_environment(), capture_output=True, text=True, timeout=_TIME_LIMIT_S)
    if not (folder / "cases.xml").is_file():
        pytest.fail(f"the cases ended with {done.returncode}\n{done.stdout}\n{done.stderr}")
    found: dict[str, list[str]] = {}
    for case in ElementTree.parse(folder / "cases.xml").iter("testcase"):
        wrong = "\n".join(f"{child.tag}: {child.get('message')}\n{child.text}" for child in case)
        found.setdefault(case.get("name", "").partition("[")[0], []).append(wrong)
    return found


@pytest.mark.parametrize("case", CASES)
def test_through_libusb(case: str, outcomes: dict[str, list[str]]) -> None:
    assert case in outcomes, "the case did not run"
    wrong = [message for message in outcomes[case] if message]
    assert not wrong, "\n".join(wrong)
