"""The text of JSON values."""

import pytest

from spike4dgs.benchmark.json_values.text import json_text


def test_equal_values_have_equal_texts() -> None:
    value, other = {"b": {"é": 1.0}, "a": [(), {}]}, {"a": ([], {}), "b": {"é": 1.0}}
    text = '{\n  "a": [\n    [],\n    {}\n  ],\n  "b": {\n    "\\u00e9": 1.0\n  }\n}\n'
    assert json_text(value) == json_text(other) == text


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_numbers_that_json_lacks_are_refused(number: float) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        json_text({"a": [{"b": [number]}]})
