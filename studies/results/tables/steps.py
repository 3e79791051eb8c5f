"""Whether rows have converged: the same fits with more steps, on scenes that no row was tuned on."""

from __future__ import annotations

from collections.abc import Sequence

from spike4dgs.benchmark.method import DEFAULT_BUDGET
from spike4dgs.studies.kit.timing import markdown
from spike4dgs.studies.results.blocks import NOTHING, both_text, of_group, provenance
from spike4dgs.studies.results.changes import change_text, legend_of
from spike4dgs.studies.results.comparison import rows_of
from spike4dgs.studies.results.plan import Group, once
from spike4dgs.studies.results.records import Record

SCENES = ("car-11-small", "jaywalk-11-small", "bird-11-small")
ROWS = (
    "spike4dgs-x",
    "spike4dgs",
    "tfp+rig-flat+4dgs.tuned",
    "adaptive+rig-flat+stg.tuned",
    "tfp+rig-flat+stg.tuned",
    "tfp+rig-flat+stg",
    "spk2img+stg",
    "tfp+stg",
    "tfp+4dgs",
)
BUDGETS = (DEFAULT_BUDGET, "standard", "16")  # 1, 4 and 16 times the steps
_HEADS = ("steps of tables", "4 times", "16 times")
GROUPS = tuple(
    Group(f"steps-{budget}", f"Fits with the budget {budget}", SCENES, once(ROWS), budget) for budget in BUDGETS
)


def steps_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of the table: PSNR with a row's own steps, and what more steps change, in dB."""
    own = [of_group(group, records) for group in GROUPS]
    if not own[0]:
        return [NOTHING]
    shown, lines = [k for k, found in enumerate(own) if found], []
    for name in ROWS:
        first, *more = (rows_of([name], SCENES, own[k])[0] for k in shown)
        if first.cells:
            lines.append([f"`{name}`", both_text(first), *(change_text(row, first) for row in more)])
    legend = f"Whole image / where things move, dB; means of {', '.join(SCENES)}. More steps are listed as changes."
    return [
        *markdown(("row", *(_HEADS[k] for k in shown)), lines),
        *("", legend_of(legend, lines), ""),
        provenance(sum(own, []), *GROUPS),
    ]
