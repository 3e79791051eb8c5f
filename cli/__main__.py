"""`python -m spike4dgs.cli COMMAND`: the same as `spike4dgs COMMAND`."""

from __future__ import annotations

import sys

from spike4dgs.cli.dispatch import main

if __name__ == "__main__":
    sys.exit(main())
