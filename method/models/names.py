"""Names in model files, where they differ from those in the code. The files of all versions have the same tensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from torch import Tensor

from spike4dgs.method.settings import Settings

BACKGROUND = "still"  # the group of the background's tensors
TENSORS = {"log_temporal_scales": "lives", "coefficients": "paths", "angular_velocities": "spins"}  # code -> file
_FROM_FILE = {saved: name for name, saved in TENSORS.items()}

# A setting of the trainer, which no motion has: earlier files hold one flat list of the settings of all parts.
_ONLY_FLAT = "coarse_steps"


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
