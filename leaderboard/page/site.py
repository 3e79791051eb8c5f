"""Write the page: files that a browser opens from a disk, without a server and without the network.

    OUT/index.html, page.css, js/, vendor/     the program, copied
    OUT/data/boards.js                         every board with its cells: the first view
    OUT/data/scores-B-METRIC.js, details-B.js  loaded when a reader asks for them
    OUT/data/cells-B.csv                       every cell of a board, for other programs
    OUT/pictures/                              images of finished runs

Browsers do not let a page from a disk fetch JSON. So data are scripts, of one call with one JSON text: no value of an
entry is ever parsed as HTML or as a program. Tables are sorted and filtered by our own code, as no small library marks
incomplete means; plots are those of Observable Plot on D3, which are vendored and whose hashes are checked.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import locked, remove_parts, write_bytes, write_text
from spike4dgs.benchmark.metrics.table import METRICS, PRIMARY
from spike4dgs.benchmark.reports.error_map import ERROR_MAX, SCALES, error_colors
from spike4dgs.benchmark.runs.results import write_results
from spike4dgs.leaderboard.page.content import board_content, details, page_metrics, score_content
from spike4dgs.leaderboard.page.intervals import (
    FEWEST_WORLDS,
    GRID,
    LEVEL,
    MOST_UNITS,
    REPLICATES,
    SEED,
    joint_value,
    widened_values,
)
from spike4dgs.leaderboard.page.pictures import write_pictures
from spike4dgs.leaderboard.page.rows import Board, titles
from spike4dgs.leaderboard.page.scores import compare_rows, image_scores
from spike4dgs.leaderboard.tracks import RELEASE, current_release

STATIC = Path(str(files("spike4dgs.leaderboard.page") / "static"))
MARK = "data/boards.js"  # what tells a page's folder from any other


@dataclass(frozen=True)
class Site:
    """What was written: the files, the bytes of the first view, and what is not shown, with reasons."""

    files: int
    first_view_bytes: int
    left_out: tuple[str, ...]


def write_site(
    out: Path,
    boards: Sequence[Board],
    refused: Sequence[Mapping[str, str]] = (),
    data: Path = Path("data"),
    progress: Callable[[str], None] = lambda text: None,
    docs: str = "",
) -> Site:
    """Write the page of some boards; equal boards give equal bytes. `docs`: the path of the documentation's site.

    An earlier page in `out` is replaced. Raises UserError where something else is there, where another process writes
    a page there, and where a vendored library is not the one that was pinned.
    """
    if out.exists() and not (out.is_dir() and ((out / MARK).is_file() or _is_empty(out))):
        raise problem(out, "a new or empty folder, or an earlier page", "something else", "choose another --out")
    if not (out / MARK).exists():  # the first file: one that is killed leaves a page, which the next one replaces
        write_text(out / MARK, "")
    with locked(out / ".lock", out, "a folder that no other page is written to", temporary=True):
        remove_parts(out)
        return _write(out, boards, refused, data, progress, docs)


def _write(
    out: Path,
    boards: Sequence[Board],
    refused: Sequence[Mapping[str, str]],
    data: Path,
    progress: Callable[[str], None],
    docs: str,
) -> Site:
    written, left_out, content = set[Path](), list[str](), []
    for path in static_files():
        write_bytes(out / path, (STATIC / path).read_bytes())
        written.add(out / path)

    def put(name: str, value: Any) -> None:
        write_text(out / "data" / f"{name}.js", script(name, value))
        written.add(out / "data" / f"{name}.js")

    for number, (board, identifier) in enumerate(zip(boards, titles(boards), strict=True)):
        progress(f"{board.name}: {len(board.rows)} rows")
        one = board_content(board, identifier)
        one["scored"] = _write_scores(board, number, put)
        put(f"details-{number}", details(board))
        write_results(table := out / "data" / f"cells-{number}.csv", [r for row in board.rows for r in row.records])
        written.add(table)
        pictures = write_pictures(out, board, number, data, written, left_out.append)
        one["pictures"] = [p is not None for p in pictures]
        put(f"pictures-{number}", pictures)
        content.append(one)
    put("boards", {**facts(boards), "docs": docs, "boards": content, "refused": list(refused)})
    for earlier in [*(out / "data").glob("*"), *(out / "pictures").rglob("*.webp")]:
        if earlier not in written and earlier.is_file():
            earlier.unlink()
    first = [p for p in written if p.relative_to(out).parts[0] not in ("data", "pictures")] + [out / MARK]
    return Site(len(written), sum(p.stat().st_size for p in first), tuple(left_out))


def _is_empty(folder: Path) -> bool:
    """Return whether a folder holds no more than folders and what a killed page left half written."""
    left = Path(MARK).stem
    return all(
        (path.is_dir() and not path.is_symlink()) or path.name.startswith(f".{left}.") for path in folder.rglob("*")
    )


def _write_scores(board: Board, number: int, put: Callable[[str, Any], None]) -> list[str]:
    """Write the scores of each metric that any row is compared by; return these metrics' ids."""
    found = []
    for metric in METRICS:
        scores = image_scores(board, metric)
        if scores.values:
            put(f"scores-{number}-{metric}", score_content(scores, compare_rows(scores, metric)))
            found.append(metric)
    return found


def facts(boards: Sequence[Board]) -> dict[str, Any]:
    """Return what all boards share: metrics, the bootstrap's settings, and the tracks that have no entries yet."""
    release, shown = current_release(), {b.name for b in boards}
    return {
        "release": RELEASE,
        "primary": PRIMARY,
        "metrics": page_metrics(),
        "bootstrap": {
            "level": LEVEL,
            "replicates": REPLICATES,
            "seed": SEED,
            "fewestWorlds": FEWEST_WORLDS,
            "grid": [round(float(v), 9) for v in GRID],
            "joint": [joint_value(n) for n in range(max((len(b.rows) for b in boards), default=0) + 1)],
            "widened": [None, None, *(widened_values(n).tolist() for n in range(2, MOST_UNITS + 1))],
        },
        "errors": {"max": ERROR_MAX, "scales": SCALES, "colors": error_colors().tolist()},
        "empty": [
            {"name": t.name, "title": t.title, "announced": t.announced} for t in release.tracks if t.name not in shown
        ],
    }


def script(name: str, value: Any) -> str:
    """Return a script that hands a JSON value to the page.

    The value is a string of the script, so that no key of it, such as __proto__, means anything to JavaScript.
    """
    text = json.dumps(value, allow_nan=False, separators=(",", ":"), ensure_ascii=True)
    return f"Spike4DGS.receive({json.dumps(name)}, {json.dumps(text)});\n"


def static_files() -> list[str]:
    """Return the files of the program below STATIC. Raises UserError where a vendored one is not as pinned."""
    vendor = STATIC / "vendor"
    for line in (vendor / "SHA256SUMS").read_text(encoding="utf-8").splitlines():
        digest, _, name = line.partition("  ")
        if (found := hashlib.sha256((vendor / name).read_bytes()).hexdigest()) != digest:
            raise problem(vendor / name, f"sha256 {digest[:16]}...", f"{found[:16]}...", "restore the file")
    return sorted(p.relative_to(STATIC).as_posix() for p in STATIC.rglob("*") if p.is_file())
