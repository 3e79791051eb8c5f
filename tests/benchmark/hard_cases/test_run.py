"""Cases that pass, fail, crash or cannot run: each is a row, and the others go on."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.hard_cases.case import Case, NotRunError, Outcome, Setting, compare
from spike4dgs.benchmark.hard_cases.run import Row, choose, run_cases
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack


def case(name: str, run: Callable[[Setting], Outcome], tolerance: float = 0.0, on_device: bool = False) -> Case:
    texts = {"asked": "a thing", "twin": "a twin", "unit": "px"}
    return Case(id=f"room/part/{name}", tolerance=tolerance, run=run, on_device=on_device, **texts)


def counts(setting: Setting, off_by: int = 0) -> Outcome:
    """Compare counts of spikes with numpy's; with `off_by` the function forgets as many ticks."""
    spikes = setting.rng().random((50, 3, 5)) < 0.4
    stream = SpikeStream(pack(spikes), 5, 3, 20000.0)
    return compare(stream.counts(0, 50 - off_by), spikes.sum(axis=0))


def crash(setting: Setting) -> Outcome:
    raise ZeroDivisionError("a hard input")


def lack(setting: Setting) -> Outcome:
    raise NotRunError("there is no camera")


def run(*cases: Case, seed: int = 0, device: str = "cpu") -> list[Row]:
    return run_cases(cases, seed, device, lambda done, total, next_case: None)


def test_a_wrong_function_fails_and_a_right_one_passes() -> None:
    right, wrong = run(case("right", counts), case("wrong", lambda s: counts(s, off_by=5)))
    assert right.passed and right.error == 0 and right.finite
    assert wrong.passed is False and wrong.error == pytest.approx(5, abs=4) and wrong.finite


def test_an_exception_is_a_failed_row_and_the_rest_go_on() -> None:
    crashed, missing, after = run(case("crash", crash), case("lack", lack), case("after", counts))
    assert crashed.passed is False and crashed.error is None
    assert crashed.came_out == "ZeroDivisionError: a hard input"
    assert missing.passed is None and missing.came_out == "not run: there is no camera"
    assert after.passed


@pytest.mark.parametrize(
    ("outcome", "passed"),
    [
        (Outcome("x", 0.5), True),
        (Outcome("x", 0.5000001), False),
        (Outcome("x", math.nan), False),
        (Outcome("x", math.inf), False),
        (Outcome("x", 0.0, finite=False), False),
    ],
)
def test_within_the_tolerance_and_finite(outcome: Outcome, passed: bool) -> None:
    assert run(case("a", lambda s: outcome, tolerance=0.5))[0].passed is passed


def test_warnings_are_told_and_fail_nothing() -> None:
    def warns(setting: Setting) -> Outcome:
        for _ in range(2):
            warnings.warn("overflow", RuntimeWarning, stacklevel=1)
        return Outcome("x", 0.0)

    (row,) = run(case("a", warns))
    assert row.passed and row.warnings == ("RuntimeWarning: overflow",)


def test_each_case_has_an_empty_folder_that_is_gone_afterwards() -> None:
    seen: list[Path] = []

    def writes(setting: Setting) -> Outcome:
        seen.append(setting.folder)
        assert not list(setting.folder.iterdir())
        (setting.folder / "x").write_bytes(b"x")
        return Outcome("x", 0.0)

    assert all(row.passed for row in run(case("a", writes), case("b", writes)))
    assert len(set(seen)) == 2 and not any(folder.exists() for folder in seen)


def test_the_seed_decides_and_the_device_is_that_of_cases_that_use_it() -> None:
    def says(setting: Setting) -> Outcome:
        return Outcome(f"{setting.seed} {setting.device} {setting.rng().integers(10**9)}", 0.0)

    cases = case("a", says), case("b", says, on_device=True)
    first, again, other = (run(*cases, seed=seed, device="cuda") for seed in (0, 0, 1))
    assert [r.came_out for r in first] == [r.came_out for r in again] != [r.came_out for r in other]
    assert [r.device for r in first] == ["cpu", "cuda"]


def test_cases_are_chosen_by_a_part_of_their_id() -> None:
    cases = [case(name, counts) for name in ("near-plane", "near-end", "far")]
    assert [c.id for c in choose(cases, "near")] == ["room/part/near-plane", "room/part/near-end"]
    assert [c.id for c in choose(cases, "PART/n*ne")] == ["room/part/near-plane"]
    assert choose(cases, None) == cases
    with pytest.raises(UserError, match="--only: expected a part of the id of a case, found 'nowhere'; .* room/part"):
        choose(cases, "nowhere")
    with pytest.raises(UserError, match="room/part/far twice"):
        choose([*cases, case("far", counts)], None)


def test_listeners_hear_every_case_and_the_end() -> None:
    heard: list[tuple[int, int, str]] = []
    run_cases([case("a", counts), case("b", crash)], 0, "cpu", lambda *told: heard.append(told))
    assert heard == [(0, 2, "room/part/a"), (1, 2, "room/part/b"), (2, 2, "")]


def test_numpys_errors_do_not_leak_into_other_cases() -> None:
    def divides(setting: Setting) -> Outcome:
        return Outcome("x", float(np.array(1.0) / np.array(0.0)))

    (row,) = run(case("a", divides))
    assert row.passed is False and row.warnings == ("RuntimeWarning: divide by zero encountered in divide",)
