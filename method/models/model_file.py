"""Tensors on disk with a hash, and fitted models: one safetensors file with tensors, their meaning and provenance.

Nothing in it is code. `kind` names the reader of the tensors (`saved_model.GROUP`), `config` holds its other arguments.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.json_values.text import parse_json
from spike4dgs.benchmark.runs.provenance import Provenance, read_provenance
from spike4dgs.benchmark.untrusted import check_header
from spike4dgs.method.settings import Settings

Tensors = dict[str, Tensor]
_DAMAGED = (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError)  # a foreign header, among others


def write_tensors(path: Path, tensors: Mapping[str, Tensor], schema: str, entries: Mapping[str, str], key: str) -> None:
    """Write atomically. `entries` are texts by name; the hash covers the tensors and the entry `key`."""
    stored = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    meta = {"schema": schema, **entries, "sha256": _digest(entries[key], stored)}
    with atomic_path(path) as part:
        safetensors.torch.save_file(stored, part, metadata=meta)


def read_tensors(path: Path, schema: str, key: str, what: str, fix: str) -> tuple[Tensors, dict[str, str]]:
    """Return the tensors and entries of a file that `write_tensors` wrote.

    Raises UserError for a damaged file and for one of another schema; `what` names the kind of file in
    the message, `fix` the remedy.
    """
    try:
        check_header(path)
        with safetensors.safe_open(path, framework="pt") as f:
            meta = f.metadata() or {}
            # Copies: a view into the file may be unaligned, and then sums are taken in another order.
            tensors = {name: f.get_tensor(name).clone() for name in f.keys()}
    except (safetensors.SafetensorError, *_DAMAGED) as e:
        raise problem(path, what, f"damaged data ({e})", fix) from None
    if meta.get("schema") != schema:
        raise problem(path, f"schema {schema}", repr(meta.get("schema")), fix)
    if meta.get("sha256") != _digest(meta.get(key, ""), tensors):
        raise problem(path, "the SHA-256 that it was written with", "damaged data", fix)
    return tensors, meta


def part(tensors: Mapping[str, Tensor], prefix: str) -> Tensors:
    """Return the tensors whose name starts with `prefix.`, without the prefix."""
    return {k.removeprefix(f"{prefix}."): v for k, v in tensors.items() if k.startswith(f"{prefix}.")}


def _digest(entry: str, tensors: Tensors) -> str:
    """Return the hash of an entry and the tensors; the format itself checks no tensor for flipped bits."""
    digest = hashlib.sha256(entry.encode())
    for name in sorted(tensors):
        digest.update(f"{name} {tuple(tensors[name].shape)} {tensors[name].dtype}".encode())
        digest.update(tensors[name].reshape(-1).view(torch.uint8).numpy().tobytes())  # NumPy lacks some types
    return digest.hexdigest()


SCHEMA = "spike4dgs-model/1"
FIX = "fit it again with `spike4dgs run-benchmark`"
ModuleT = TypeVar("ModuleT", bound=nn.Module)
WITHOUT_MEMORY = torch.device("meta")

# Names in files, where they differ from those in the code. The files of all versions have the same tensors.
BACKGROUND = "still"  # the group of the background's tensors
TENSORS = {"log_temporal_scales": "lives", "coefficients": "paths", "angular_velocities": "spins"}  # code -> file
_FROM_FILE = {saved: name for name, saved in TENSORS.items()}

# A setting of the trainer, which no motion has: earlier files hold one flat list of the settings of all parts.
_ONLY_FLAT = "coarse_steps"


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


def to_file_names(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors under their names in files."""
    return {TENSORS.get(name, name): value for name, value in tensors.items()}


def from_file_names(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors of a file under their names in the code."""
    return {_FROM_FILE.get(name, name): value for name, value in tensors.items()}


def motion_settings(saved: Mapping[str, Any], defaults: Settings) -> dict[str, Any]:
    """Return a motion's settings from a file, of this version or of one with a flat list of all settings.

    Of a flat list all that rendering needs has the same name here; learning rates had others and are left out.
    """
    if _ONLY_FLAT not in saved:
        return dict(saved)
    return {f.name: saved[f.name] for f in fields(defaults) if f.name in saved}


def make_filled(make: Callable[[], ModuleT], tensors: Mapping[str, Tensor]) -> ModuleT:
    """Return the module that `make` makes, with these tensors. Raises ValueError where they are not all of its own.

    It is made without memory first, so that a file's numbers allocate no more than its tensors.
    """
    with WITHOUT_MEMORY:
        wanted = {name: tuple(t.shape) for name, t in make().state_dict().items()}
    found = {name: tuple(t.shape) for name, t in tensors.items()}
    if wrong := sorted(n for n in wanted.keys() | found.keys() if wanted.get(n) != found.get(n)):
        raise ValueError(
            f"{wrong[0]} {found.get(wrong[0], 'missing')} in place of {wanted.get(wrong[0], 'none')}"[:200]
        )
    made = make()
    made.load_state_dict(dict(tensors))
    return made
