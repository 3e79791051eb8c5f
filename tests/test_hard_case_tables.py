"""The hard cases of each room that take little time pass, also with another seed than the report's."""

from __future__ import annotations

import pytest

from spike4dgs.baselines.hard_cases.table import hard_cases as of_baselines
from spike4dgs.benchmark.hard_cases.case import Case
from spike4dgs.benchmark.hard_cases.run import choose, run_cases
from spike4dgs.benchmark.hard_cases.table import hard_cases as of_benchmark
from spike4dgs.generators.hard_cases.table import hard_cases as of_generators
from spike4dgs.method.hard_cases.table import hard_cases as of_method

TABLES = {"baselines": of_baselines, "benchmark": of_benchmark, "generators": of_generators, "method": of_method}
QUICK = [case for table in TABLES.values() for case in choose(table(), None) if case.seconds <= 0.1]


@pytest.mark.parametrize("case", QUICK, ids=lambda c: c.id)
def test_a_quick_case_passes(case: Case) -> None:
    (row,) = run_cases([case], 7, "cpu", lambda done, total, next_case: None)
    assert row.passed is not False, (row.came_out, row.error)
    assert not row.warnings


@pytest.mark.parametrize("room", TABLES)
def test_ids_name_their_room(room: str) -> None:
    assert all(case.id.startswith(f"{room}/") and case.asked and case.twin for case in TABLES[room]())
