"""Compiled schemas against jsonschema: what they take is valid, and what we ship is taken at once."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from mutations import VALUES, Raw, pick

from spike4dgs.benchmark import schemas
from spike4dgs.benchmark.json_values.schema_checks import compiled
from spike4dgs.benchmark.schemas import load_schema
from spike4dgs.leaderboard.tracks import SHIPPED

PACKAGES = (
    "spike4dgs.benchmark",
    "spike4dgs.benchmark.release",
    "spike4dgs.leaderboard",
    "spike4dgs.leaderboard.season",
    "spike4dgs.studies",
    "spike4dgs.studies.kit",
)
SCHEMAS = [(p, f.name) for p in PACKAGES for f in files(p).iterdir() if f.name.endswith(".schema.json")]
ENTRIES = sorted(SHIPPED.glob("entries/*/*.json"))
SHIPPED_FILES = [
    *((path, "entry.schema.json") for path in ENTRIES[:3] + ENTRIES[-3:]),
    (SHIPPED / "leaderboard.json", "leaderboard.schema.json"),
    (SHIPPED / "releases" / "1.json", "release.schema.json"),
]


def check(schema: dict[str, Any], value: Any) -> bool:
    return compiled(schema, lambda name: load_schema("spike4dgs.benchmark", name))(value)


def is_valid(schema: dict[str, Any], value: Any) -> bool:
    return bool(Draft202012Validator(schema, registry=schemas._registry()).is_valid(value))


@pytest.mark.parametrize(("package", "name"), SCHEMAS)
def test_every_schema_compiles(package: str, name: str) -> None:
    assert not check(load_schema(package, name), []) or name == "common.schema.json"  # that one has definitions alone


@pytest.mark.parametrize(("path", "name"), SHIPPED_FILES, ids=lambda value: Path(value).name)
def test_shipped_files_are_taken_without_jsonschema(path: Path, name: str) -> None:
    assert check(load_schema("spike4dgs.leaderboard", name), json.loads(path.read_text(encoding="utf-8")))


def places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield every place of a JSON value as a container and a key of it."""
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield value, key
        yield from places(value[key])


def small_entry() -> dict[str, Any]:
    """Return an entry of one scene with two images, in which a random place is often one that matters."""
    entry: dict[str, Any] = json.loads(ENTRIES[-1].read_text(encoding="utf-8"))
    for cell in entry["record"]["scenes"].values():
        cell["per_image"] = dict(list(cell["per_image"].items())[:2])
    entry["record"]["method"]["params"] = {}
    return entry


def test_changed_entries_are_taken_only_if_they_are_valid() -> None:
    schema, rng = load_schema("spike4dgs.leaderboard", "entry.schema.json"), np.random.default_rng(0)
    values = [v for v in VALUES if not isinstance(v, Raw)] + ["ok", "failed", "claimed", "re-fitted", 3.0, "a" * 64]
    run, original = compiled(schema, lambda name: load_schema("spike4dgs.benchmark", name)), small_entry()
    taken = refused = 0
    for _ in range(400):
        entry = copy.deepcopy(original)
        container, key = pick(rng, list(places(entry)))
        if isinstance(container, dict) and rng.random() < 0.3:
            if rng.random() < 0.5:
                del container[key]
            else:
                container[str(pick(rng, ["x", "../x", "", "a\n", "x" * 200]))] = container[key]
        else:
            container[key] = pick(rng, values)
        if run(entry):
            taken += 1
            assert is_valid(schema, entry), (key, container)
        else:
            refused += 1
    assert taken > 20 and refused > 100  # the changes reach both sides


CASES: list[tuple[dict[str, Any], list[Any]]] = [
    ({"type": "integer", "minimum": 1, "maximum": 3}, [1, 3, 0, 4, True, "1", None, 2.5]),
    ({"type": ["number", "null"], "exclusiveMinimum": 0, "exclusiveMaximum": 1}, [0.5, 0, 1, None, False, "0.5"]),
    ({"type": "boolean"}, [True, False, 0, 1, None]),
    ({"minimum": 1}, [0, 1, "text", None, []]),
    ({"const": "a"}, ["a", "b", 1, None, ["a"]]),
    ({"const": 1}, [1, 2, True, "1"]),
    ({"enum": ["a", "b"]}, ["a", "c", None]),
    ({"type": "string", "minLength": 1, "maxLength": 2, "pattern": "^a"}, ["a", "ab", "", "abc", "ba", 1]),
    ({"pattern": "b"}, ["abc", "ac", 3]),
    ({"type": "array", "minItems": 1, "maxItems": 2, "items": {"type": "string"}}, [["a"], [], ["a", 1], ["a"] * 3]),
    ({"uniqueItems": True}, [["a", "b"], ["a", "a"], "aa"]),
    ({"type": "object", "minProperties": 1, "maxProperties": 1}, [{"a": 1}, {}, {"a": 1, "b": 1}, []]),
    ({"required": ["a"], "properties": {"a": {"type": "null"}}}, [{"a": None}, {"a": 1}, {}, 1]),
    ({"properties": {"a": {}}, "additionalProperties": False}, [{"a": 1}, {"b": 1}, {}]),
    ({"additionalProperties": {"type": "null"}}, [{"a": None}, {"a": 1}]),
    ({"propertyNames": {"pattern": "^a"}}, [{"a": None}, {"b": None}, {}]),
    ({"anyOf": [{"type": "null"}, {"type": "string"}]}, [None, "a", 1]),
    ({"allOf": [{"minimum": 1}, {"maximum": 2}]}, [1, 2, 3, 0]),
    ({"not": {"required": ["a"]}}, [{}, {"a": 1}, 1]),
    ({"if": {"properties": {"a": {"const": "x"}}}, "then": {"required": ["b"]}, "else": {"required": ["c"]}},
     [{"a": "x", "b": 1}, {"a": "x"}, {"a": "y", "c": 1}, {"a": 1}, {"b": 1}, 1]),
    ({"$ref": "#/$defs/d", "$defs": {"d": {"type": "string"}}}, ["a", 1]),
    ({"$ref": "common.schema.json#/$defs/id"}, ["car-0", "../car", "a\n", ""]),
]  # fmt: skip


@pytest.mark.parametrize(("schema", "values"), CASES, ids=[",".join(schema) for schema, _ in CASES])
def test_each_keyword_as_in_jsonschema(schema: dict[str, Any], values: list[Any]) -> None:
    assert [check(schema, v) for v in values] == [is_valid(schema, v) for v in values]
    assert len({is_valid(schema, v) for v in values}) == 2


@pytest.mark.parametrize(
    "schema", [{"format": "date"}, {"not": {"minimum": 1}}, {"if": {"properties": {"a": {"const": 1}}}}]
)
def test_what_is_not_compiled_is_refused(schema: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="not compiled"):
        check(schema, {})
