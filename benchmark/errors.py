"""The one error type that users see, and the one form of its sentence."""

from __future__ import annotations

from pathlib import Path

_MOST_FOUND = 1000  # characters: a hostile file's text can have millions


class UserError(Exception):
    """Bad input. The message is one line: where, what was expected, what was found and what to do."""


def problem(where: str | Path, expected: str, found: str, fix: str) -> UserError:
    """Build the error for bad input, for the caller to raise.

    >>> str(problem("spikes/cam_00.dat", "500000 bytes", "499999 bytes", "copy the file again"))
    'spikes/cam_00.dat: expected 500000 bytes, found 499999 bytes; copy the file again'
    """
    if len(found) > _MOST_FOUND:
        found = f"{found[:_MOST_FOUND]}..."
    return UserError(" ".join(f"{where}: expected {expected}, found {found}; {fix}".split()))
