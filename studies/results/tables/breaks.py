"""What breaks whom, at which size: the mildest amount of each cause that costs a row much."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from spike4dgs.studies.kit.timing import markdown
from spike4dgs.studies.results.blocks import NOTHING, commits_text, of_group
from spike4dgs.studies.results.changes import legend_of, mark
from spike4dgs.studies.results.comparison import changes
from spike4dgs.studies.results.records import Record
from spike4dgs.studies.results.tables.conditions import CONDITIONS, GROUP, NONE, Condition, of_conditions, rows_under

BROKEN_DB = 3  # twice the error
NAMED = {condition.name: condition for condition in CONDITIONS}
LEVELS: dict[str, dict[float, str]] = {  # a cause -> the names of its conditions, by amount
    "light": {1 / 64: "light 1/64", 1 / 16: "light 1/16", 1 / 4: "light 1/4", 1: NONE.name, 2: "light times 2"},
    "speed": {1: NONE.name, 2: "twice as fast", 4: "four times as fast"},
    "length of the clip, ms": {5: "5 ms", 20: NONE.name, 100: "100 ms, turntable-2 alone", 500: "500 ms, car-1 alone"},
    "cameras": {3: "3 of 8 cameras", 5: "5 of 8 cameras", 8: NONE.name},
}


def amount_text(amount: float) -> str:
    """Return an amount as pages have it.

    >>> amount_text(1 / 16), amount_text(2)
    ('1/16', '2')
    """
    return f"{amount:g}" if amount >= 1 else f"1/{1 / amount:g}"


def breaks_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of a table: for each cause and row the mildest amount that costs `BROKEN_DB` or more."""
    own = of_conditions(records)
    if not of_group(GROUP, own):
        return [NOTHING]
    names = [row.name for row in GROUP.rows]
    lines = [
        [cause, ", ".join(map(amount_text, side)), *(_broken(name, side, own) for name in names)]
        for cause, side in _sides()
    ]
    legend = (
        f"The mildest amount that costs {BROKEN_DB} dB or more, in the whole image / where things move; "
        f'"no" where no measured amount does, "-" where nothing was measured. {_others(own, names)} '
        f"{commits_text(own)}."
    )
    text = legend_of(legend, [*lines, [legend]])
    return [*markdown(("cause", "amounts", *(f"`{name}`" for name in names)), lines), "", text]


def _sides() -> Iterator[tuple[str, dict[float, str]]]:
    """Yield each cause with its amounts on one side of what there is without a condition, the mildest first."""
    for cause, levels in LEVELS.items():
        (usual,) = (amount for amount, name in levels.items() if name == NONE.name)
        for side in (sorted((a for a in levels if a < usual), reverse=True), sorted(a for a in levels if a > usual)):
            if side:
                yield cause, {amount: levels[amount] for amount in side}


def _broken(name: str, side: Mapping[float, str], own: Sequence[Record]) -> str:
    """Return the mildest amounts, with the mark of other code where a measured change has it."""
    measured = {amount: found for amount, level in side.items() if (found := _changes(name, NAMED[level], own))}
    if not measured:
        return "-"
    broken = [[a for a, (change, _) in measured.items() if change[k] <= -BROKEN_DB] for k in (0, 1)]
    texts = " / ".join(amount_text(amounts[0]) if amounts else "no" for amounts in broken)
    return texts + max(marked for _, marked in measured.values())


def _changes(name: str, condition: Condition, own: Sequence[Record]) -> tuple[list[float], str] | None:
    """Return what a condition changes for a row, as `changes`, and the mark; None where it was not measured."""
    row, without = (rows_under([name], c, own)[0] for c in (condition, condition.absent))
    found = changes(row, without)
    return None if found is None else (found, mark(row, without))


def _others(own: Sequence[Record], names: Sequence[str]) -> str:
    """Return a sentence on the conditions of one size alone."""
    sized = {name for levels in LEVELS.values() for name in levels.values()}
    broken = []
    for condition in CONDITIONS:
        if condition.name not in sized:
            measured = {name: found for name in names if (found := _changes(name, condition, own))}
            rows = [f"`{name}`{marked}" for name, (change, marked) in measured.items() if min(change) <= -BROKEN_DB]
            broken += [f"{condition.name} ({', '.join(rows)})"] if rows else []
    return f"Of the other conditions, {'; '.join(broken) or 'none'} costs a row as much."
