"""Checkpoints: one safetensors file with everything a fit needs to go on as if it had never stopped."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.method import Progress
from spike4dgs.method.gaussians.optimizer import Adam, export_state, import_state
from spike4dgs.method.models.model_file import part, read_tensors, write_tensors
from spike4dgs.method.torch_state import one_torch_thread

_SCHEMA = "spike4dgs-checkpoint/1"


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Tensors by name and the step that comes next."""

    step: int
    tensors: dict[str, Tensor]

    @classmethod
    def of(cls, step: int, **parts: Mapping[str, Tensor]) -> Checkpoint:
        """Return the checkpoint of several parts, each tensors by name."""
        return cls(step, {f"{part}.{name}": v for part, tensors in parts.items() for name, v in tensors.items()})

    def part(self, prefix: str, device: torch.device | None = None) -> dict[str, Tensor]:
        """Return the tensors whose name starts with `prefix.`, without it; on a device, if one is given."""
        found = part(self.tensors, prefix)
        return found if device is None else {name: v.to(device) for name, v in found.items()}


def save_checkpoint(path: Path, checkpoint: Checkpoint, fit: str) -> None:
    """Write atomically. `fit` identifies scene, recipe, settings and seed."""
    write_tensors(path, checkpoint.tensors, _SCHEMA, {"step": str(checkpoint.step), "fit": fit}, "step")


def load_checkpoint(path: Path, fit: str) -> Checkpoint | None:
    """Read a checkpoint; None where there is no file.

    Raises UserError for a damaged file and for one of another fit.
    """
    if not path.is_file():
        return None
    fix = "delete it to fit from the start"
    tensors, meta = read_tensors(path, _SCHEMA, "step", "a checkpoint", fix)
    step = meta.get("step", "")
    if not step.isdecimal():
        raise problem(path, "the number of a step", repr(step), fix)
    if meta.get("fit") != fit:
        raise problem(path, "a checkpoint of this scene, recipe, budget and seed", "another fit's", fix)
    return Checkpoint(int(step), tensors)


def run_steps(
    fit: Any, progress: Progress, path: Path | None, key: str, checkpoint_s: float, note: Callable[[], str] = lambda: ""
) -> None:
    """Train to the end, from the checkpoint `path` where it exists; it is written every `checkpoint_s` seconds.

    `fit` has `step`, `total`, `train_step`, `state` and `restore`; `key` identifies it, `note` adds to its progress.
    Raises UserError for a damaged checkpoint or one of another fit.
    """
    if path and (saved := load_checkpoint(path, key)):
        fit.restore(saved)
    written = time.monotonic()
    with one_torch_thread():
        while fit.step < fit.total:
            loss = fit.train_step()
            if path and (time.monotonic() - written >= checkpoint_s or fit.step == fit.total):
                save_checkpoint(path, fit.state(), key)
                written = time.monotonic()
            if fit.step % 10 == 0 or fit.step == fit.total:
                progress(fit.step, fit.total, f"loss {loss.item():.4f}{note()}")


def save_training(path: Path, step: int, network: nn.Module, adam: Adam, fit: str) -> None:
    """Write everything that the training of a network needs to go on from `step`."""
    save_checkpoint(path, Checkpoint.of(step, network=network.state_dict(), adam=export_state(adam)), fit)


def resume_training(path: Path, network: nn.Module, adam: Adam, fit: str) -> int:
    """Put back what `save_training` wrote; returns the step to go on from, 0 where there is no checkpoint.

    Raises UserError for a damaged or foreign one.
    """
    found = load_checkpoint(path, fit)
    if not found:
        return 0
    network.load_state_dict(found.part("network"))
    import_state(adam, found.part("adam"))
    return found.step
