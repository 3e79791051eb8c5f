"""`report results`: measure the plan's cells, write the pages' blocks from the records, or check them."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import OmitArgPrefixes

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.method import find_methods
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.studies.results.code_state import check_clean, code_state, find_root
from spike4dgs.studies.results.loose_figures import counts, loose_figures, read_ratchet, risen, tighten
from spike4dgs.studies.results.pages import outdated, pages_of, write_pages
from spike4dgs.studies.results.plan import ABLATIONS, PLAN, TRIAL, Cell, cells_of
from spike4dgs.studies.results.records import Record, read_records
from spike4dgs.studies.results.sweep import SweepSettings, sweep
from spike4dgs.studies.results.tables import conditions, modality, paper, parts, realistic, steps
from spike4dgs.studies.results.tables.images import TABLE6

EVERY_GROUP = (
    *PLAN,
    TABLE6,
    *ABLATIONS,
    conditions.GROUP,
    conditions.REFINED,
    *conditions.VIEWS,
    conditions.CONTENT,
    conditions.CEILINGS,
    modality.GROUP,
    modality.NOISY,
    paper.GROUP,
    parts.GROUP,
    realistic.GROUP,
    *steps.GROUPS,
)


@dataclass(frozen=True)
class Choice:
    """Which cells are measured, and how.

    Args:
        only: Groups of the plan: table1 to table4, table6, table7, unposed (table 1, poses estimated), views-3 to
            views-8 (table 5), conditions, conditions-refined, conditions-views-3 and -5, content, ceilings (of
            conditions and content), modality, modality-noisy, paper, parts, small, steps-quick, steps-standard,
            steps-16, or trial (two tiny scenes). All but trial if left out.
        rows: Names of rows; all rows of the groups if left out.
        scenes_of: Folder of the scenes. Planned scenes that it does not contain are skipped.
        out: Folder for predictions and checkpoints.
        workers: Number of fitting processes, each on its share of this machine's cores.
        limit_hours: Start no new cell after this many hours.
        quiet: Nothing else runs on this machine, so the times count. Cells measured while other programs ran are fitted
            again.
        allow_dirty: Measure code that is not committed; its records say so.
    """

    only: tuple[str, ...] = ()
    rows: tuple[str, ...] = ()
    scenes_of: Path = Path("data/ideal")
    out: Path = Path("runs/results")
    workers: int = 1
    limit_hours: float | None = None
    quiet: bool = False
    allow_dirty: bool = False


def results(
    *,
    write: bool = False,
    check: bool = False,
    records: Path | None = None,
    choice: OmitArgPrefixes[Choice] = Choice(),
) -> int:
    """Fit and score what the published tables show, and keep a record of each cell; a killed sweep resumes.

    With --write nothing is fitted: the blocks of README.md and docs/results/*.md are made of the records. With --check
    they are compared with the records, and figures of quality outside of them are listed. Runs in a checkout that is
    installed with `pip install -e .`. Returns 1 if a cell failed, or if a page is not as the records say.

    Args:
        write: Write the pages' blocks from the records.
        check: Compare the pages with the records.
        records: Folder of the records, ROW.json; studies/results/records of the checkout if left out.
    """
    root = find_root()
    folder = root / "studies" / "results" / "records" if records is None else records
    if write or check:
        if choice != Choice():
            expected, fix = "neither --write nor --check beside options of a sweep", "leave one of them out"
            raise problem("report results", expected, "both", fix)
        known = list(read_records(folder).values())
        if write:
            _write(root, known)
        return _check(root, known) if check else 0
    state = code_state(root)
    check_clean(state, choice.allow_dirty)
    settings = SweepSettings(
        choice.scenes_of, folder, choice.out, choice.workers, choice.limit_hours, choice.quiet
    )  # fmt: skip
    outcome = sweep(_cells(choice), find_methods(), state, settings, make_console())
    for line in outcome.failed:
        print(f"failed: {line}", file=sys.stderr)
    print(f"records: {folder}; {outcome.left} planned cells left" if outcome.left else f"records: {folder}; complete")
    return 1 if outcome.failed else 0


def _cells(choice: Choice) -> list[Cell]:
    known = {group.name: group for group in (*EVERY_GROUP, TRIAL)}
    if unknown := [name for name in choice.only if name not in known]:
        raise problem("--only", f"groups among {', '.join(known)}", ", ".join(unknown), "correct the names")
    cells = cells_of([known[name] for name in choice.only] or EVERY_GROUP)
    rows = dict.fromkeys(cell.row for cell in cells)
    if unknown := [name for name in choice.rows if name not in rows]:
        raise problem("--rows", f"rows among {', '.join(rows)}", ", ".join(unknown), "correct the names")
    return [cell for cell in cells if not choice.rows or cell.row in choice.rows]


def _write(root: Path, records: list[Record]) -> None:
    for page in write_pages(root, records):
        print(f"written: {page.relative_to(root)}")
    tighten(root, counts(root))


def _check(root: Path, records: list[Record]) -> int:
    """List what is not of the records; return 1 where a block differs from them, or loose figures have become more."""
    for page in pages_of(root):
        for line, figure in loose_figures(page.read_text("utf-8")):
            print(f"{page.relative_to(root)}:{line}: {figure}")
    found, most = counts(root), read_ratchet(root)
    for name, count in found.items():
        print(f"{name}: {count} figures outside generated blocks, {most.get(name, 0)} allowed")
    wrong = [f"{page.relative_to(root)}: its blocks are not what the records give" for page in outdated(root, records)]
    wrong += [f"more figures outside generated blocks: {line}" for line in risen(found, most)]
    for text in wrong:
        print(text, file=sys.stderr)
    if wrong:
        print("run `spike4dgs report results --write`, or take the figures out of the text", file=sys.stderr)
    return int(bool(wrong))
