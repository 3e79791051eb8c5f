"""The provenance of a saved model: method, scene, cameras, clock, commit.

The runner writes it, and programs that show models read it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from spike4dgs.benchmark.scene.cameras import Camera, from_nerfstudio, to_nerfstudio
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.benchmark.screen.shown import Shown
from spike4dgs.benchmark.untrusted import check_ids


@dataclass(frozen=True, eq=False, repr=False)
class Provenance(Shown):
    """The method, the scene and the run that a fitted model comes from."""

    method: dict[str, Any]  # name, version, params (recipe and settings), seed, trained_on
    scene: str
    scene_revision: str
    split: str
    cameras: tuple[Camera, ...]  # the training cameras, calibrated
    rate_hz: float
    n_ticks: int
    radiance_gain: float
    budget: float | str
    device: str
    fit_seconds: float
    harness: dict[str, Any]  # version, commit and dirty flag of this package
    created: str

    @property
    def name(self) -> str:
        """The method's name."""
        return str(self.method["name"])

    @property
    def duration_us(self) -> float:
        """Length of the clip in microseconds."""
        return self.n_ticks * 1e6 / self.rate_hz

    def _about(self) -> str:
        made = f"seed {self.method['seed']}, budget {self.budget}, fitted in {self.fit_seconds:.1f} s on {self.device}"
        return f"{self.name} on {self.scene}: {made}, {self.created}"

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; cameras in nerfstudio's keys, as in a scene folder."""
        cameras = [{"camera": c.id, **to_nerfstudio(c)} for c in self.cameras]
        return {k: v for k, v in asdict(self).items() if k != "cameras"} | {"cameras": cameras}


def read_provenance(value: Mapping[str, Any], where: str, fix: str) -> Provenance:
    """Read the values of `as_dict`. Raises UserError where one is missing, of another type or out of bounds."""
    check_schema(dict(value), load_schema("spike4dgs.benchmark", "provenance.schema.json"), where, fix)
    cameras = tuple(from_nerfstudio(c["camera"], c, where) for c in value["cameras"])
    check_ids([c.id for c in cameras], "camera", where, fix)
    return Provenance(**{**value, "cameras": cameras})


@runtime_checkable
class Savable(Protocol):
    """A model that can be written to a file and rendered later."""

    def save(self, path: Path, provenance: Provenance) -> None:
        """Write the model and its provenance atomically to one file."""
        ...
