"""`python -m spike4dgs.studies.speed NAME`: the same as `spike4dgs speed NAME`."""

from __future__ import annotations

import sys

from spike4dgs.cli import main

if __name__ == "__main__":
    sys.exit(main(["speed", *sys.argv[1:]]))
