"""The text of JSON values against the standard library's."""

from __future__ import annotations

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spike4dgs.benchmark.json_values.text import json_text


@settings(max_examples=40, deadline=None)
@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
        lambda values: st.lists(values) | st.dictionaries(st.text(), values) | st.tuples(values, values),
    )
)
def test_json_has_the_text_of_the_standard_library(value: object) -> None:
    assert json_text(value) == json.dumps(value, indent=2, sort_keys=True) + "\n"


def test_json_with_keys_that_are_numbers_and_without_values_that_are_none() -> None:
    value = {"b": {2: [1, {"x": []}], 10: {}}, "a": [[], {1: 2}]}
    assert json_text(value) == json.dumps(value, indent=2, sort_keys=True) + "\n"
    for number in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="not JSON compliant"):
            json_text({"a": [{"b": [number]}]})
