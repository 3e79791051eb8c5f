"""YAML files: plain values alone, bounded in size, without aliases."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import yaml

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_text

MOST_BYTES = 1 << 16  # a camera takes some hundred; the parser reads some 30 kB a second


class _Loader(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
    """PyYAML's safe loader without aliases: a few of them can stand for more values than memory holds."""

    maps: Collection[str] = ()  # foreign tags of maps

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias, such as *name")
        node = super().compose_node(parent, index)
        if node.tag in self.maps and isinstance(node, yaml.MappingNode):
            node.tag = "tag:yaml.org,2002:map"
        return node


def read_yaml(path: Path, what: str) -> Any:
    """Return the value of a YAML file. `what` names the kind of file for the error.

    Raises UserError where the file is missing or too large, where it is no YAML, and where it has aliases.
    """
    try:
        return parse_yaml(read_text(path, what, MOST_BYTES))
    except ValueError as e:
        raise problem(path, f"{what} (YAML)", f"damaged text ({e})", "restore the file") from None


def parse_yaml(text: str, maps: Collection[str] = ()) -> Any:
    """Return the value of a YAML text; maps with a tag among `maps` are plain ones.

    Raises ValueError for bad syntax, aliases, other tags and values nested too deep.
    """

    class Loader(_Loader):
        pass

    Loader.maps = maps
    try:
        return yaml.load(text, Loader)  # a safe loader
    except RecursionError:
        raise ValueError("values nested too deep") from None
    except (yaml.YAMLError, ValueError, OverflowError, LookupError, TypeError, AttributeError) as e:
        raise ValueError(str(e)[:200]) from None
