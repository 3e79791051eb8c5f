"""The hard cases of this room that take little time pass, also with another seed than the report's."""

from __future__ import annotations

import pytest

from spike4dgs.benchmark.hard_cases.case import Case
from spike4dgs.benchmark.hard_cases.run import choose, run_cases
from spike4dgs.generators.hard_cases.table import hard_cases

QUICK = [case for case in choose(hard_cases(), None) if case.seconds <= 0.1]


@pytest.mark.parametrize("case", QUICK, ids=lambda c: c.id)
def test_a_quick_case_passes(case: Case) -> None:
    (row,) = run_cases([case], 7, "cpu", lambda done, total, next_case: None)
    assert row.passed is not False, (row.came_out, row.error)
    assert not row.warnings


def test_ids_name_this_room() -> None:
    assert all(case.id.startswith("generators/") and case.asked and case.twin for case in hard_cases())
