"""How a case's result becomes an error: worst differences, NaN where it belongs, refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.hard_cases.case import Outcome, Setting, compare, described, refused, worst

NAN, INF = math.nan, math.inf


@pytest.mark.parametrize(
    ("found", "expected", "error", "finite"),
    [
        ([1.0, 2.0], [1.0, 2.5], 0.5, True),
        ([1.0, NAN], [1.0, NAN], 0.0, True),  # NaN is expected there
        ([1.0, 2.0], [1.0, NAN], 0.0, False),  # a number where there should be none
        ([1.0, NAN], [1.0, 2.0], NAN, False),
        ([1.0, INF], [1.0, 2.0], INF, False),
        ([], [], 0.0, True),
    ],
)
def test_the_worst_difference_counts(found: list[float], expected: list[float], error: float, finite: bool) -> None:
    outcome = compare(found, expected)
    assert outcome.finite == finite
    assert outcome.error == error or (math.isnan(error) and math.isnan(outcome.error))


def test_relative_errors_are_of_the_whole_array() -> None:
    a, b = np.random.default_rng(0).normal(size=(2, 30))
    assert compare(a, b, relative=True).error == pytest.approx(np.linalg.norm(a - b) / np.linalg.norm(b), rel=1e-12)
    assert compare([0.5], [0.0], relative=True).error == 0.5, "nothing to be relative to"


def test_other_shapes_differ_by_infinity() -> None:
    assert compare(np.zeros((2, 3)), np.zeros((3, 2))).error == INF


def test_the_worst_of_several_is_named_and_what_is_not_finite_comes_first() -> None:
    found = worst({"a": Outcome("1", 0.5), "b": Outcome("2", 0.1, finite=False), "c": Outcome("3", 0.7)})
    assert found.came_out == "3 of 3 compared; the worst is b: 2" and not found.finite
    assert "is b: nan" in worst({"a": Outcome("1", 0.5), "b": Outcome("nan", NAN)}).came_out


def test_only_user_errors_are_refusals() -> None:
    def refuse() -> None:
        raise problem("here", "this", "that", "do so")

    def crash() -> None:
        raise ValueError("broken")

    assert refused({"a": refuse}).error == 0 and "expected this" in refused({"a": refuse}).came_out
    both = refused({"a": refuse, "taken": lambda: 3})
    assert both.error == 1 and "taken gave int" in both.came_out
    with pytest.raises(ValueError, match="broken"):
        refused({"a": crash})


def test_arrays_are_described_with_what_is_missing() -> None:
    assert described(np.array([1.0, NAN, 3.0])) == "3 values from 1 to 3, 1 not finite"
    assert described(np.full(2, NAN)) == "2 values, none of them finite"
    assert described(np.zeros((0, 4))) == "nothing"


def test_a_setting_gives_the_same_numbers_again(tmp_path) -> None:  # type: ignore[no-untyped-def]
    a, b = (Setting(seed, "cpu", tmp_path).rng().random(5) for seed in (3, 3))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, Setting(4, "cpu", tmp_path).rng().random(5))
