"""The ledger of a leaderboard has a line for every entry that `submit` wrote.

    <sha256 of the entry's canonical JSON>  entries/2-ideal@0123456789ab/tfp+4dgs.json
    <sha256 of an earlier entry>  entries/2-ideal@0123456789ab/tfp+4dgs.json  replaced

So an entry that was edited by hand, put back in the place of a later one, or removed is noticed. Lines are sorted, and
stay when an entry is replaced; who withdraws an entry, or moves it to the archive, takes its lines along. Ledgers of
earlier versions mark nothing: each of their lines counts until the entry is replaced. Who edits an entry and the ledger
alike is noticed only when the entry is verified again from its predictions.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import write_text
from spike4dgs.leaderboard.tracks import ARCHIVE, LOCAL, PUBLIC

FOLDERS = (PUBLIC, LOCAL, ARCHIVE)
LEDGER = "LEDGER"
Ledger = frozenset[tuple[str, str]]  # (sha256, path below the leaderboard) of the entries that should be there
_REPLACED = "  replaced"
_LINE = re.compile(rf"([0-9a-f]{{64}})  (\S+)({_REPLACED})?")


def entry_paths(leaderboard: Path, *folders: str) -> Iterator[str]:
    """Yield the paths of the entries in the given ones of `FOLDERS`, sorted; hidden files are none."""
    for folder in folders:
        for path in sorted((leaderboard / folder).glob("*/*.json")):
            name = path.relative_to(leaderboard)
            if not any(part.startswith(".") for part in name.parts):
                yield name.as_posix()


def same_but_for_case(paths: Collection[str]) -> dict[str, list[str]]:
    """Return the others in the same one of `FOLDERS` whose method's name is that of an entry but for case, by path.

    >>> same_but_for_case(["local/a@0/Flat.json", "local/b@0/flat@seed-3.json", "local/b@0/other.json"])
    {'local/a@0/Flat.json': ['local/b@0/flat@seed-3.json'], 'local/b@0/flat@seed-3.json': ['local/a@0/Flat.json']}
    """
    alike: dict[tuple[str, str], dict[str, str]] = {}
    for path in sorted(paths):
        method = Path(path).stem.partition("@seed-")[0]
        alike.setdefault((path.partition("/")[0], method.casefold()), {})[path] = method
    found = {}
    for methods in alike.values():
        for path, method in methods.items():
            if others := [other for other, theirs in methods.items() if theirs != method]:
                found[path] = others
    return found


def read_ledger(leaderboard: Path) -> Ledger:
    """Return the lines of the ledger that are not marked as replaced; none in a leaderboard without entries.

    Raises UserError for a damaged line, and where there are entries and no ledger.
    """
    return frozenset(line for line, replaced in _read(leaderboard).items() if not replaced)


def add_line(leaderboard: Path, sha256: str, path: str) -> None:
    """Add a line to the ledger. The caller holds the leaderboard's lock."""
    _write(leaderboard, {**_read(leaderboard), (sha256, path): False})


def mark_replaced(leaderboard: Path, sha256: str, path: str) -> None:
    """Mark the lines of a path's other entries as replaced. The caller holds the leaderboard's lock."""
    before = _read(leaderboard)
    after = {line: replaced or (line[1] == path and line[0] != sha256) for line, replaced in before.items()}
    if after != before:
        _write(leaderboard, after)


def check_listed(sha256: str, path: str, where: Path, ledger: Ledger) -> None:
    """Raise UserError unless the ledger has a line for the entry at `path` with this hash."""
    if (sha256, path) not in ledger:
        fix = "restore the entry, or submit its record again with --replace"
        found = "another one, as after an edit by hand, or an earlier one"
        raise problem(where, f"an entry as {LEDGER} lists it", found, fix)


def _read(leaderboard: Path) -> dict[tuple[str, str], bool]:
    """Return whether an entry is marked as replaced, by the hash and path of each line."""
    path = leaderboard / LEDGER
    if not path.is_file():
        if next(entry_paths(leaderboard, *FOLDERS), None):
            raise problem(path, "the ledger of the entries", "none", "restore the file from version control")
        return {}
    lines: dict[tuple[str, str], bool] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        if not (match := _LINE.fullmatch(line)):
            expected = "lines of a sha256, two blanks and an entry's path"
            raise problem(path, expected, f"line {number}: {line[:80]!r}", "restore the file from version control")
        key = (match[1], match[2])
        lines[key] = lines.get(key, False) or match[3] is not None
    return lines


def _write(leaderboard: Path, lines: dict[tuple[str, str], bool]) -> None:
    ordered = sorted(lines.items(), key=lambda line: (line[0][1], line[0][0]))
    text = "".join(f"{sha256}  {path}{_REPLACED if replaced else ''}\n" for (sha256, path), replaced in ordered)
    write_text(leaderboard / LEDGER, text)
