"""LEDGER: the SHA-256 of every entry that `submit` wrote, so that an entry that was edited by hand is noticed.

    <sha256 of the entry's canonical JSON>  entries/1-outdoor-small@0123456789ab/tfp+4dgs.json

Lines are sorted and never removed. Who edits an entry and the ledger alike is noticed only when the entry is verified
again from its predictions.
"""

from __future__ import annotations

import re
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import write_text

NAME = "LEDGER"
_LINE = re.compile(r"([0-9a-f]{64})  (\S+)")
Ledger = frozenset[tuple[str, str]]  # (sha256, path below the leaderboard)


def read_ledger(leaderboard: Path) -> Ledger:
    """Return the lines of the ledger; none where there is no such file. Raises UserError for a damaged line."""
    path = leaderboard / NAME
    if not path.is_file():
        return frozenset()
    found = set()
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        if not (match := _LINE.fullmatch(line)):
            expected = "lines of a sha256, two blanks and an entry's path"
            raise problem(path, expected, f"line {number}: {line[:80]!r}", "restore the file from version control")
        found.add((match[1], match[2]))
    return frozenset(found)


def add_line(leaderboard: Path, sha256: str, path: str) -> None:
    """Add a line to the ledger. The caller holds the leaderboard's lock."""
    lines = sorted({*read_ledger(leaderboard), (sha256, path)}, key=lambda line: (line[1], line[0]))
    write_text(leaderboard / NAME, "".join(f"{digest}  {name}\n" for digest, name in lines))
