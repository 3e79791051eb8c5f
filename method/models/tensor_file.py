"""Named tensors in one safetensors file, with a schema, text entries, and a hash of tensors and entries."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import safetensors
import safetensors.torch
from torch import Tensor

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.untrusted import check_header

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
        digest.update(tensors[name].numpy().tobytes())
    return digest.hexdigest()
