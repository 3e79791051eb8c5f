"""The one error type that users see, and the one form of its sentence."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from os.path import commonprefix
from pathlib import Path

_MOST_FOUND = 1000  # characters: a hostile file's text can have millions
_MOST_NAMES = 15  # that a message lists where another place does too


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


def unknown(where: str | Path, name: str, known: Iterable[str], listed: str = "") -> UserError:
    """Build the error for a name that is none of the known ones, with the nearest of them.

    `listed` says where all are listed, if they are: a message then leaves out a long list.

    >>> str(unknown("--metric", "psrn", ["psnr", "ssim"]))
    "--metric: expected one of psnr, ssim, found 'psrn'; did you mean 'psnr'?"
    """
    names = list(known)
    same = commonprefix([name, *names]).rfind(".") + 1  # a part's name, which all share, makes none of them nearer
    near = difflib.get_close_matches(name[same:_MOST_FOUND], [n[same:] for n in names])
    near = [name[:same] + n for n in near]
    expected = f"one of {', '.join(names) or 'none'}"
    if listed and len(names) > _MOST_NAMES:
        expected = f"a name that {listed} lists" + (f", such as {', '.join(near)}" if near else "")
    return problem(where, expected, repr(name), f"did you mean {near[0]!r}?" if near else "correct the name")
