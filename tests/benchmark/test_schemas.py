"""Our schemas: fastjsonschema reads them as jsonschema does, and takes what we ship."""

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from mutations import VALUES, Raw, pick

from spike4dgs.benchmark import schemas
from spike4dgs.benchmark.schemas import load_schema
from spike4dgs.leaderboard.tracks import SHIPPED

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(p for room in ("benchmark", "leaderboard", "studies") for p in (ROOT / room).rglob("*.schema.json"))
ENTRIES = sorted(SHIPPED.glob("entries/*/*.json"))
SHIPPED_FILES = [
    *((path, "entry.schema.json") for path in ENTRIES[:3] + ENTRIES[-3:]),
    (SHIPPED / "leaderboard.json", "leaderboard.schema.json"),
    (SHIPPED / "releases" / "1.json", "release.schema.json"),
]
# fastjsonschema passes over keywords that draft-07 lacks, and over all beside a $ref.
IN_BOTH_DRAFTS = set(
    "$ref type properties required additionalProperties propertyNames minProperties maxProperties items minItems "
    "maxItems uniqueItems pattern minLength maxLength minimum maximum exclusiveMinimum exclusiveMaximum if then else "
    "not anyOf allOf const enum".split()
)
TEXTS = {"$schema", "title", "description", "$defs"}


def parts(schema: Any) -> Iterator[dict[str, Any]]:
    """Yield a schema and all schemas in it."""
    if isinstance(schema, dict):
        yield schema
        for key, value in schema.items():
            inner = value.values() if key in ("properties", "$defs") else value if isinstance(value, list) else [value]
            for part in inner:
                yield from parts(part)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.parent.name + "/" + path.name)
def test_schemas_mean_the_same_in_draft_07(path: Path) -> None:
    schema = json.loads(path.read_text(encoding="utf-8"))
    for part in parts(schema):
        allowed = {"$ref"} if "$ref" in part else IN_BOTH_DRAFTS
        assert part.keys() <= allowed | TEXTS, part
        assert not isinstance(part.get("items"), list), part
    assert not schemas._is_taken([], schema) or path.name == "common.schema.json"  # that one has definitions alone


@pytest.mark.parametrize(("path", "name"), SHIPPED_FILES, ids=lambda value: Path(value).name)
def test_shipped_files_are_taken_without_jsonschema(path: Path, name: str) -> None:
    assert schemas._is_taken(json.loads(path.read_text(encoding="utf-8")), load_schema("spike4dgs.leaderboard", name))


def places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield every place of a JSON value as a container and a key of it."""
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield value, key
        yield from places(value[key])


def small_entry() -> dict[str, Any]:
    """Return an entry of one scene with two images, in which a random place is often one that matters."""
    entry: dict[str, Any] = json.loads(ENTRIES[-1].read_text(encoding="utf-8"))
    scene, cell = next(iter(entry["record"]["scenes"].items()))
    entry["record"]["scenes"] = {scene: {**cell, "per_image": dict(list(cell["per_image"].items())[:2])}}
    entry["record"]["method"]["params"] = {}
    return entry


def test_changed_entries_are_taken_only_if_they_are_valid() -> None:
    schema, rng = load_schema("spike4dgs.leaderboard", "entry.schema.json"), np.random.default_rng(0)
    values = [v for v in VALUES if not isinstance(v, Raw)] + ["ok", "failed", "claimed", "re-fitted", "a" * 64]
    values += [3.0, float("nan"), float("inf")]
    validator, original = Draft202012Validator(schema, registry=schemas._registry()), small_entry()
    taken = refused = 0
    for _ in range(200):
        entry = copy.deepcopy(original)
        container, key = pick(rng, list(places(entry)))
        if isinstance(container, dict) and rng.random() < 0.3:
            if rng.random() < 0.5:
                del container[key]
            else:
                container[str(pick(rng, ["x", "../x", "", "a\n", "x" * 200]))] = container[key]
        else:
            container[key] = pick(rng, values)
        if schemas._is_taken(entry, schema):
            taken += 1
            assert validator.is_valid(entry), (key, container)
        else:
            refused += 1
    assert taken > 20 and refused > 50  # the changes reach both sides
