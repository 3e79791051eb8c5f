"""`run-benchmark` with all its options as keywords."""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from spike4dgs.cli import run_benchmark as command


def run_benchmark(scenes: Sequence[Path] = (), **options: Any) -> int:
    """Run the command; the options are those of its groups, by their names in Python."""
    groups: dict[str, Any] = {}
    kinds = {"choice": command.SceneChoice, "fits": command.FitChoice, "entries": command.EntryChoice}
    for name, kind in kinds.items():
        groups[name] = kind(**{f.name: options.pop(f.name) for f in fields(kind) if f.name in options})
    return command.run_benchmark(tuple(scenes), **groups, **options)
