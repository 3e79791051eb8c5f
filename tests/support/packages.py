"""Packages of others, installed by pip into a folder of their own."""

import subprocess
import sys
from pathlib import Path


def install(source: Path, target: Path) -> None:
    """Build a package and install it into a folder, by pip."""
    offline = ("--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check", "--quiet")
    command = [sys.executable, "-m", "pip", "install", *offline, "--target", str(target), str(source)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
