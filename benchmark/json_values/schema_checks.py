"""JSON Schemas compiled to functions: whether a value follows a schema, some hundred times as fast as jsonschema.

`compiled` knows the keywords that our schemas use and raises ValueError for any other. What it takes, jsonschema takes
too. Where it refuses a value, jsonschema says what is wrong, or takes the value after all, such as 3.0 for an integer.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

Check = Callable[[Any], bool]
Find = Callable[[str], Mapping[str, Any]]
_TEXTS = {"$schema", "title", "description", "$defs"}
_NUMBERS = ("minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum")
_OBJECTS = ("properties", "required", "additionalProperties", "propertyNames", "minProperties", "maxProperties")
_ARRAYS = ("items", "minItems", "maxItems", "uniqueItems")
_STRINGS = ("pattern", "minLength", "maxLength")
_PARTS = ("if", "then", "else", "not", "anyOf", "allOf", "const", "enum")
_NUMERIC, _CONTAINERS = (int, float), (dict, list)  # `int | float` would be made at every check
_KNOWN_NAMES = 4096  # names whose pattern was looked for: ids, metrics and images come again and again


def compiled(schema: Mapping[str, Any], find: Find) -> Check:
    """Return a function that says whether a value follows a schema; `find` returns a schema by its file name.

    >>> check = compiled({"type": "object", "properties": {"a": {"minimum": 1}}}, {}.__getitem__)
    >>> check({"a": 1.5}), check({"a": 0}), check([])
    (True, False, False)
    """
    return _Compiler(find).schema(schema, schema)


class _Compiler:
    """Compiles the parts of schemas, those that are referred to once each."""

    def __init__(self, find: Find) -> None:
        self._find = find
        self._referred: dict[tuple[int, str], Check] = {}

    def schema(self, schema: Any, root: Mapping[str, Any]) -> Check:
        """Return the check of a part of the schema `root`."""
        if isinstance(schema, bool):
            return lambda value: schema
        if unknown := schema.keys() - {"$ref", "type", *_TEXTS, *_NUMBERS, *_OBJECTS, *_ARRAYS, *_STRINGS, *_PARTS}:
            raise ValueError(f"keywords of a JSON Schema that are not compiled: {', '.join(sorted(unknown))}")
        checks: list[Check] = []
        if "type" in schema:
            checks.append(_of_types(schema["type"]))
        if "$ref" in schema:
            checks.append(self._reference(schema["$ref"], root))
        if any(k in schema for k in _NUMBERS):
            checks.append(_bounds(schema))
        if any(k in schema for k in _STRINGS):
            checks.append(_strings(schema))
        if any(k in schema for k in _OBJECTS):
            checks.append(self._objects(schema, root))
        if any(k in schema for k in _ARRAYS):
            checks.append(self._arrays(schema, root))
        checks += self._combined(schema, root)
        return _all(checks)

    def _reference(self, ref: str, root: Mapping[str, Any]) -> Check:
        file, _, pointer = ref.partition("#")
        root = self._find(file) if file else root
        key = (id(root), pointer)
        if key not in self._referred:
            part: Any = root
            for name in pointer.split("/")[1:]:
                part = part[name]
            self._referred[key] = self.schema(part, root)
        return self._referred[key]

    def _objects(self, schema: Mapping[str, Any], root: Mapping[str, Any]) -> Check:
        properties = {name: self.schema(part, root) for name, part in schema.get("properties", {}).items()}
        required = tuple(schema.get("required", ()))
        names = self.schema(schema["propertyNames"], root) if "propertyNames" in schema else None
        known = lru_cache(_KNOWN_NAMES)(names) if names else None
        others = self.schema(schema.get("additionalProperties", True), root)
        closed, is_open = schema.get("additionalProperties") is False, schema.get("additionalProperties", True) is True
        fewest, most = schema.get("minProperties", 0), schema.get("maxProperties", float("inf"))

        def check(value: Any) -> bool:
            if not isinstance(value, dict):
                return True
            if not fewest <= len(value) <= most:
                return False
            for name in required:
                if name not in value:
                    return False
            if known:
                for name in value:
                    if not known(name):
                        return False
            for name, item in value.items():
                if own := properties.get(name):
                    if not own(item):
                        return False
                elif closed or not (is_open or others(item)):
                    return False
            return True

        return check

    def _arrays(self, schema: Mapping[str, Any], root: Mapping[str, Any]) -> Check:
        item = self.schema(schema.get("items", True), root)
        fewest, most = schema.get("minItems", 0), schema.get("maxItems", float("inf"))
        unique = schema.get("uniqueItems", False)

        def check(value: Any) -> bool:
            if not isinstance(value, list):
                return True
            if not fewest <= len(value) <= most or not all(map(item, value)):
                return False
            # Our lists of unique items hold strings; others are left to jsonschema.
            return not unique or (all(isinstance(v, str) for v in value) and len(set(value)) == len(value))

        return check

    def _combined(self, schema: Mapping[str, Any], root: Mapping[str, Any]) -> list[Check]:
        found: list[Check] = []
        if "const" in schema:
            found.append(_equals([schema["const"]]))
        if "enum" in schema:
            found.append(_equals(schema["enum"]))
        if "anyOf" in schema:
            found.append(_any([self.schema(part, root) for part in schema["anyOf"]]))
        found += [self.schema(part, root) for part in schema.get("allOf", ())]
        if "not" in schema:
            refused = self.exact(schema["not"], root)
            found.append(lambda value: not refused(value))
        if "if" in schema:
            condition = self.exact(schema["if"], root)
            then, other = (self.schema(schema.get(key, True), root) for key in ("then", "else"))
            found.append(lambda value: then(value) if condition(value) else other(value))
        return found

    def exact(self, schema: Mapping[str, Any], root: Mapping[str, Any]) -> Check:
        """Return the check of a condition, which must refuse nothing that jsonschema takes.

        Raises ValueError for a condition of anything else than required keys and constant texts.
        """
        parts = schema.get("properties", {}).values()
        if schema.keys() - {"properties", "required", "not"} or not all(
            part.keys() == {"const"} and isinstance(part["const"], str) for part in parts
        ):
            raise ValueError(f"a condition that is not compiled: {schema}")
        return self.schema(schema, root)


def _all(checks: list[Check]) -> Check:
    if len(checks) == 1:
        return checks[0]
    if len(checks) == 2:
        first, second = checks
        return lambda value: first(value) and second(value)

    def check_all(value: Any) -> bool:
        for check in checks:
            if not check(value):
                return False
        return True

    return check_all


def _any(checks: list[Check]) -> Check:
    def check_any(value: Any) -> bool:
        for check in checks:
            if check(value):
                return True
        return False

    return check_any


_CLASSES: dict[str, tuple[type, ...]] = {
    "object": (dict,),
    "array": (list,),
    "string": (str,),
    "null": (type(None),),
    "boolean": (bool,),
    "number": (int, float),
    "integer": (int,),  # jsonschema also takes 3.0
}


def _of_types(names: str | list[str]) -> Check:
    names = [names] if isinstance(names, str) else names
    classes, truths = tuple(c for name in names for c in _CLASSES[name]), "boolean" in names
    return lambda value: isinstance(value, classes) and (truths or not isinstance(value, bool))


def _bounds(schema: Mapping[str, Any]) -> Check:
    infinite = float("inf")
    low, high = schema.get("minimum", -infinite), schema.get("maximum", infinite)
    above, below = schema.get("exclusiveMinimum"), schema.get("exclusiveMaximum")

    def check(value: Any) -> bool:
        if not isinstance(value, _NUMERIC) or isinstance(value, bool):
            return True
        return low <= value <= high and (above is None or value > above) and (below is None or value < below)

    return check


def _strings(schema: Mapping[str, Any]) -> Check:
    fewest, most = schema.get("minLength", 0), schema.get("maxLength", float("inf"))
    pattern = re.compile(schema.get("pattern", ""))

    def check(value: Any) -> bool:
        return not isinstance(value, str) or (fewest <= len(value) <= most and pattern.search(value) is not None)

    return check


def _equals(values: list[Any]) -> Check:
    """Return the check that a value is one of texts; for other values jsonschema, to which 1 is no true, decides."""
    texts = frozenset(v for v in values if isinstance(v, str))
    others = [v for v in values if not isinstance(v, str)]
    return lambda value: value in texts if isinstance(value, str) else any(_same(value, v) for v in others)


def _same(a: Any, b: Any) -> bool:
    return type(a) is type(b) and not isinstance(a, _CONTAINERS) and bool(a == b)
