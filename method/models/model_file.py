"""Fitted models on disk: one safetensors file with tensors, their meaning and their provenance.

Nothing in it is code. `kind` names the reader of the tensors (`saved_model.GROUP`), `config` holds its other arguments.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import parse_json
from spike4dgs.benchmark.runs.provenance import Provenance, read_provenance
from spike4dgs.method.models.tensor_file import part, read_tensors, write_tensors

SCHEMA = "spike4dgs-model/1"
FIX = "fit it again with `spike4dgs run-benchmark`"


@dataclass(frozen=True, eq=False)
class ModelFile:
    """A model as it is on disk: JSON values and named tensors, in groups `GROUP.name`."""

    kind: str
    config: Mapping[str, Any]
    tensors: Mapping[str, Tensor]
    provenance: Provenance

    def part(self, group: str) -> dict[str, Tensor]:
        """Return the tensors of a group by name."""
        return part(self.tensors, group)


def group(**groups: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return copies of the tensors of several groups, named for `ModelFile.part`; the originals may share memory."""
    return {f"{name}.{k}": v.detach().clone() for name, tensors in groups.items() for k, v in tensors.items()}


def write_model(path: Path, model: ModelFile) -> None:
    """Write atomically."""
    about = {"kind": model.kind, "config": dict(model.config), "provenance": model.provenance.as_dict()}
    text = json.dumps(about, sort_keys=True, allow_nan=False)
    write_tensors(path, model.tensors, SCHEMA, {"about": text}, "about")


def read_model(path: Path) -> ModelFile:
    """Read a model's file. Raises UserError where it is missing, damaged, or something else."""
    if path.is_dir():
        inside = ", ".join(sorted(p.name for p in path.glob("*.safetensors"))[:9]) or "none"
        raise problem(path, "a model's file", f"a folder (models in it: {inside})", "name one file")
    if not path.is_file():
        raise problem(
            path, "a fitted model", "no such file", "run-benchmark writes OUT/models/METHOD/SCENE.safetensors"
        )
    tensors, meta = read_tensors(path, SCHEMA, "about", "a fitted model", FIX)
    try:
        about = parse_json(meta.get("about", ""))
        kind, config, origin = about["kind"], dict(about["config"]), dict(about["provenance"])
    except (ValueError, KeyError, TypeError) as e:
        raise problem(path, "kind, config and provenance of a model", repr(e)[:200], FIX) from None
    return ModelFile(str(kind), config, tensors, read_provenance(origin, str(path), FIX))
