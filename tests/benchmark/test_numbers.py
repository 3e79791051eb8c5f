"""Numbers of files: a type and a range, and messages that can be printed."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from spike4dgs.benchmark.untrusted import number, positive, shown, whole


@pytest.mark.parametrize("value", [10**400, 1e308, float("inf"), float("nan"), True, None, "1", [1], -1, 10.5])
def test_what_is_no_number_of_a_range(value: Any) -> None:
    for read in (lambda: number(value, 0, 10), lambda: positive(value, 10), lambda: whole(value, 0, 10)):
        with pytest.raises(ValueError, match="is no number from 0 to 10"):
            read()


def test_numbers_of_a_range() -> None:
    assert number(3, 0, 10) == 3.0 and positive(0.5, 10) == 0.5
    assert whole(3, 0, 10) == whole(3.0, 0, 10) == 3 and isinstance(whole(3.0, 0, 10), int)
    with pytest.raises(ValueError, match="not positive"):
        positive(0, 10)
    with pytest.raises(ValueError, match="no whole number"):
        whole(3.5, 0, 10)


@given(st.integers(0, 2**63))
def test_whole_numbers_keep_every_digit(value: int) -> None:
    assert whole(value, 0, 2**63) == value


def test_any_value_can_be_shown() -> None:
    deep: list[Any] = []
    for _ in range(100_000):
        deep = [deep]
    assert shown(10**5000) == shown(deep) == "a value too large to print"
    assert shown("x" * 500).endswith("...") and len(shown("x" * 500)) == 60 and shown(1.5) == "1.5"
