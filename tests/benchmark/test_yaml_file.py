"""YAML files: plain values, and refusals of what a parser should not be given."""

from __future__ import annotations

from pathlib import Path

import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.untrusted import MOST_YAML_BYTES, read_yaml

BOMB = "a: &a [x, x, x]\n" + "".join(
    f"{b}: &{b} [*{a}, *{a}, *{a}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


def test_plain_values(tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text("a: {b: [1, 2.5, text]}\nc: true\n")
    assert read_yaml(tmp_path / "x.yaml", "a file") == {"a": {"b": [1, 2.5, "text"]}, "c": True}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, "an alias"),
        ("a: &a {b: 1}\nc: {<<: *a}", "an alias"),
        ("[" * 5000, "nested too deep|expected"),
        ("a: [", "damaged text"),
        ("a: !!python/object/apply:os.system [echo]", "could not determine a constructor"),
        ("a: " + "9" * 5000, "damaged text"),
        ("a: 2001-99-99", "damaged text"),
        ("? [a]\n: 1", "unhashable"),
        ("a: 1\n" * MOST_YAML_BYTES, f"{MOST_YAML_BYTES} bytes at most"),
        (b"a: \xff", "damaged text"),
    ],
)
def test_texts_that_are_refused(tmp_path: Path, text: str | bytes, message: str) -> None:
    (tmp_path / "x.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UserError, match=message) as e:
        read_yaml(tmp_path / "x.yaml", "a file")
    assert "\n" not in str(e.value)
