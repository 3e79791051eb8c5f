"""Checkpoints: one safetensors file with everything a fit needs to go on as if it had never stopped."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import safetensors
import safetensors.torch
from torch import Tensor

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path

_SCHEMA = "spike4dgs-checkpoint/1"


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Tensors by name and the step that comes next."""

    step: int
    tensors: dict[str, Tensor]

    def part(self, prefix: str) -> dict[str, Tensor]:
        """The tensors whose name starts with `prefix.`, without it."""
        return {k.removeprefix(f"{prefix}."): v for k, v in self.tensors.items() if k.startswith(f"{prefix}.")}


def save_checkpoint(path: Path, checkpoint: Checkpoint, fit: str) -> None:
    """Write atomically. `fit` identifies scene, recipe, settings and seed."""
    tensors = {k: v.detach().cpu().contiguous() for k, v in checkpoint.tensors.items()}
    digest = _digest(checkpoint.step, tensors)
    meta = {"schema": _SCHEMA, "step": str(checkpoint.step), "fit": fit, "sha256": digest}
    with atomic_path(path) as part:
        safetensors.torch.save_file(tensors, part, metadata=meta)


def load_checkpoint(path: Path, fit: str) -> Checkpoint | None:
    """Read a checkpoint; None where there is no file.

    Raises UserError for a damaged file and for one of another fit.
    """
    if not path.is_file():
        return None
    fix = "delete it to fit from the start"
    try:
        with safetensors.safe_open(path, framework="pt") as f:
            meta = f.metadata() or {}
            # Copies: a view into the file may be unaligned, and then sums are taken in another order.
            tensors = {name: f.get_tensor(name).clone() for name in f.keys()}
    except (safetensors.SafetensorError, OSError, UnicodeError) as e:
        raise problem(path, "a checkpoint", f"damaged data ({e})", fix) from None
    if meta.get("schema") != _SCHEMA:
        raise problem(path, f"schema {_SCHEMA}", repr(meta.get("schema")), fix)
    step = meta.get("step", "")
    if not step.isdecimal() or meta.get("sha256") != _digest(int(step), tensors):
        raise problem(path, "the SHA-256 that it was written with", "damaged data", fix)
    if meta.get("fit") != fit:
        raise problem(path, "a checkpoint of this scene, recipe, budget and seed", "another fit's", fix)
    return Checkpoint(int(step), tensors)


def _digest(step: int, tensors: dict[str, Tensor]) -> str:
    """The format checks its header only; a flipped bit in a moment would go unnoticed."""
    digest = hashlib.sha256(str(step).encode())
    for name in sorted(tensors):
        digest.update(f"{name} {tuple(tensors[name].shape)} {tensors[name].dtype}".encode())
        digest.update(tensors[name].numpy().tobytes())
    return digest.hexdigest()
