"""What a table lacks, and changes between two measurements, as text: marked where the code of the method differs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.baselines.recipes import INITIALIZATIONS
from spike4dgs.baselines.recipes import METHODS as THEIRS
from spike4dgs.benchmark.runs.refinement import SUFFIX as REFINED
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.recipes import METHODS as OURS
from spike4dgs.method.tuned import is_tuned
from spike4dgs.studies.results.comparison import MeasuredRow, changes
from spike4dgs.studies.results.plan import Group
from spike4dgs.studies.results.records import Record

OTHER_CODE = "†"
_LEARNED = {
    *(name for name, maker in IMAGES.items() if maker.made_on),  # networks alone have a choice of device
    *(name for name, start in INITIALIZATIONS.items() if start.networks),
}


def kind_of(row: str) -> tuple[str, ...]:
    """Return what a row's digests of code are of. Those of two kinds differ even where the code is equal."""
    name = row.removesuffix(REFINED).partition("[")[0]
    if is_tuned(name):
        return (name,)  # they cover its settings
    method = OURS.get(name) or THEIRS.get(name)
    recipe = method.recipe if isinstance(method, RecipeMethod) else None
    parts = (recipe.images, recipe.initialization) if recipe else (name.removesuffix(".images").partition("+")[0],)
    return "ours" if name in OURS else "theirs", *(part for part in parts if part in _LEARNED)


def mark(row: MeasuredRow, other: MeasuredRow) -> str:
    """Return `OTHER_CODE` where two rows were measured with different code, else nothing.

    Digests of two kinds cannot be compared: then commits tell.
    """
    keys = ("code",) if kind_of(row.name) == kind_of(other.name) else ("code", "commit")
    facts = [[{r[key] for r in each.cells.values()} for each in (row, other)] for key in keys]
    return OTHER_CODE * all(one != two for one, two in facts)


def change_text(row: MeasuredRow, other: MeasuredRow) -> str:
    """Return `changes` as `both_text` has values, with the mark of other code; "-" where there are none."""
    found = changes(row, other)
    return "-" if found is None else " / ".join(f"{change:+.2f}" for change in found) + mark(row, other)


def legend_of(text: str, lines: Iterable[Sequence[str]]) -> str:
    """Return the legend of a table, with a sentence on `OTHER_CODE` where a line has the mark."""
    marked = any(OTHER_CODE in cell for line in lines for cell in line)
    note = (
        f" {OTHER_CODE}: the two were measured with different code, or at commits whose digests cannot be compared. "
        "That may explain a part of the change."
    )
    return text + note * marked


def incomplete_lines(rows: Iterable[MeasuredRow]) -> list[str]:
    """Return a paragraph about the rows that are not ranked."""
    texts = []
    for row in (row for row in rows if not row.is_complete):
        failed = (f"; {scene}, seed {seed}: {error}" for (scene, seed), error in row.failed.items())
        texts.append(f"`{row.name}` ({row.scenes_there} of {len(row.scenes)} scenes{''.join(failed)})")
    return [f"Incomplete, not ranked: {', '.join(texts)}.", ""] if texts else []


def unmeasured_lines(group: Group, own: Iterable[Record]) -> list[str]:
    """Return a paragraph about the planned rows of which there is no record."""
    there = {r["row"] for r in own}
    lacking = [f"`{row.name}`" for row in group.rows if row.name not in there]
    return [f"Planned and not measured yet: {', '.join(lacking)}.", ""] if lacking else []
