"""Changes between two measurements, as text: marked where the code of the method differs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from spike4dgs.benchmark.runs.refinement import SUFFIX as REFINED
from spike4dgs.studies.results.comparison import MeasuredRow, changes

OTHER_CODE = "†"


def change_text(row: MeasuredRow, other: MeasuredRow) -> str:
    """Return `changes` as `both_text` has values, marked where one method's code differs; "-" where there are none."""
    found = changes(row, other)
    same_row = row.name.removesuffix(REFINED) == other.name.removesuffix(REFINED)
    mixed = same_row and {r["code"] for r in row.cells.values()} != {r["code"] for r in other.cells.values()}
    return "-" if found is None else " / ".join(f"{change:+.2f}" for change in found) + OTHER_CODE * mixed


def legend_of(text: str, lines: Iterable[Sequence[str]]) -> str:
    """Return the legend of a table, with a sentence on `OTHER_CODE` where a line has the mark."""
    marked = any(OTHER_CODE in cell for line in lines for cell in line)
    note = f" {OTHER_CODE}: the two were measured with different code of the row, which is a part of the change."
    return text + note * marked
