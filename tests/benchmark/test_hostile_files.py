"""Hostile files for every reader: errors in one line, little memory, nothing written elsewhere.

`SPIKE4DGS_HOSTILE=10000` gives the readers as many; a failure names the case, the number and what was done to it.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import hostile_files

INPUTS = int(os.environ.get("SPIKE4DGS_HOSTILE", "200"))


def test_readers_give_documented_errors_alone() -> None:
    script = Path(hostile_files.__file__)
    command = [sys.executable, str(script), "--inputs", str(INPUTS), "--seed", "3"]
    done = _run(command)
    if done.returncode and "compiling" in done.stderr:  # that takes more memory than readers do: measure once more
        done = _run(command)
    assert done.returncode == 0, (done.stdout + done.stderr)[-6000:]
    assert f"{INPUTS} inputs in" in done.stdout and "0 failures" in done.stdout


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, timeout=600 + INPUTS)
