"""Validation against the JSON Schemas that ship with the packages: one error form for every kind of file."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from importlib.resources import files as package_files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spike4dgs.benchmark.errors import problem

if TYPE_CHECKING:
    from referencing.jsonschema import SchemaRegistry


@cache
def load_schema(package: str, name: str) -> dict[str, Any]:
    """Return the JSON Schema `name` of one of our packages, such as ("spike4dgs.benchmark", "result.schema.json")."""
    schema: dict[str, Any] = json.loads((package_files(package) / name).read_text(encoding="utf-8"))
    return schema


@cache
def _registry() -> SchemaRegistry:
    """Return the schemas of this package by file name, so that one may refer to parts of another."""
    from referencing import Registry, Resource

    resources: SchemaRegistry = Registry()
    for entry in package_files("spike4dgs.benchmark").iterdir():
        if entry.name.endswith(".schema.json"):
            schema = load_schema("spike4dgs.benchmark", entry.name)
            resources = resources.with_resource(entry.name, Resource.from_contents(schema))
    return resources


_compiled: dict[int, tuple[dict[str, Any], Callable[[Any], Any]]] = {}  # by id of a schema, which it keeps alive


def _is_taken(value: Any, schema: dict[str, Any]) -> bool:
    """Return whether fastjsonschema takes a value, which is some forty times as fast as jsonschema.

    What it takes, jsonschema takes too. Where it refuses a value, jsonschema says what is wrong, or takes the value.
    """
    import fastjsonschema

    if id(schema) not in _compiled:
        check = fastjsonschema.compile(
            {**schema, "$schema": "http://json-schema.org/draft-07/schema#"},  # the newest draft that it knows in full
            handlers={"": lambda name: load_schema("spike4dgs.benchmark", name)},
            use_default=False,
        )
        _compiled[id(schema)] = schema, check
    try:
        _compiled[id(schema)][1](value)
    except fastjsonschema.JsonSchemaValueException:
        return False
    return True


def check_schema(value: Any, schema: dict[str, Any], where: str | Path, fix: str) -> None:
    """Raise UserError that names the first difference of `value` from `schema`, and the schema's title."""
    if _is_taken(value, schema):
        return
    from jsonschema import Draft202012Validator

    validator = Draft202012Validator(schema, registry=_registry())
    errors = sorted(validator.iter_errors(value), key=lambda e: (list(map(str, e.absolute_path)), e.message))
    for error in errors:
        path = "/".join(str(p) for p in error.absolute_path) or "the top level"
        raise problem(where, f"a valid {schema['title']}", f"at {path}: {error.message[:200]}", fix)
