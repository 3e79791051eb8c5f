"""The model that tracking fits: Gaussians with a position, a rotation and a colour at each of some times."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from spike4dgs.benchmark.runs.provenance import Provenance
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.models.fitted_model import GaussianModel, count_bytes, light_of_file, light_part
from spike4dgs.method.models.model_file import ModelFile, group, write_model
from spike4dgs.method.splat import Splats


@dataclass(frozen=True, eq=False)
class Tracks:
    """The values that change, at T times."""

    times_us: Tensor  # [T] float64, ascending
    free: Tensor  # [M] which Gaussians move
    rows: Tensor  # [R] which change their colour
    means: Tensor  # [T, M, 3] m
    quats: Tensor  # [T, M, 4] unit quaternions
    colors: Tensor  # [T, R, 1]

    @classmethod
    def start(cls, gaussians: Gaussians, free: Tensor, rows: Tensor, ticks: tuple[int, ...], rate_hz: float) -> Tracks:
        """Return tracks on which all times are as the Gaussians are, until `put` changes them."""
        times = torch.tensor(ticks, dtype=torch.float64) * (1e6 / rate_hz)
        quats = torch.nn.functional.normalize(gaussians.quats[free], dim=-1)
        values = (gaussians.means[free], quats, gaussians.colors[rows])
        return cls(times, free, rows, *(v.repeat(len(ticks), 1, 1) for v in values))

    def check(self, gaussians: Gaussians) -> None:
        """Raise ValueError unless these are tracks of those Gaussians."""
        t, m, r = len(self.times_us), len(self.free), len(self.rows)
        shapes = {"means": (t, m, 3), "quats": (t, m, 4), "colors": (t, r, gaussians.colors.shape[1])}
        for name, value in self.tensors().items():
            if tuple(value.shape) != shapes[name] or value.dtype != torch.float32:
                raise ValueError(f"{name} of {t} times is {value.dtype} {tuple(value.shape)}, and not {shapes[name]}")
        for index in (self.free, self.rows):
            inside = (
                index.ndim == 1 and index.dtype == torch.int64 and bool(((index >= 0) & (index < len(gaussians))).all())
            )
            if not inside:
                raise ValueError(f"tracks of others than the {len(gaussians)} Gaussians")
        if self.times_us.ndim != 1 or t == 0 or not bool((self.times_us.diff() > 0).all()):
            raise ValueError("times that do not ascend")

    def tensors(self) -> dict[str, Tensor]:
        """Return the tracked values, by name."""
        return {"means": self.means, "quats": self.quats, "colors": self.colors}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Copy the values that `tensors` gave."""
        for name, value in self.tensors().items():
            value.copy_(tensors[name])

    def at(self, index: int) -> dict[str, Tensor]:
        """Return the values at one of the times."""
        return {name: value[index] for name, value in self.tensors().items()}

    def put(self, index: int, values: dict[str, Tensor]) -> None:
        """Set the values at one of the times."""
        self.means[index], self.colors[index] = values["means"], values["colors"]
        self.quats[index] = torch.nn.functional.normalize(values["quats"], dim=-1)

    def between(self, t_us: float) -> dict[str, Tensor]:
        """Return values at any time: positions and rotations linear between and beyond the times, colours between them.

        Two times are so near to each other that a normalised linear quaternion is the spherical one for all purposes:
        at 5 degrees a time the angle is wrong by less than 0.001 degrees.
        """
        if len(self.times_us) == 1:
            return self.at(0)
        j = int(torch.searchsorted(self.times_us, torch.tensor(t_us, dtype=torch.float64)))
        j = min(max(j, 1), len(self.times_us) - 1)
        start, stop = self.times_us[j - 1 : j + 1].tolist()
        w = (t_us - start) / (stop - start)
        low, high = self.at(j - 1), self.at(j)
        return {
            "means": torch.lerp(low["means"], high["means"], w),
            "quats": torch.lerp(low["quats"], high["quats"], w),
            "colors": torch.lerp(low["colors"], high["colors"], min(max(w, 0.0), 1.0)),
        }


@dataclass(frozen=True, eq=False, repr=False)
class TrackedModel(GaussianModel):
    """The Gaussians of the first time and their tracks."""

    KIND: ClassVar = "tracking"

    gaussians: Gaussians
    tracks: Tracks
    duration_us: float
    cameras: tuple[Camera, ...] = ()  # the training cameras, as the fit had them; not saved
    light: Tensor | None = None  # factors of all light over equal parts of the clip [n]; colours are in its mean

    @property
    def device(self) -> str:  # type: ignore[override]
        """The device of the model's tensors."""
        return str(self.gaussians.means.device)

    def _about(self) -> str:
        times = f"tracks of {len(self.tracks.free)} at {len(self.tracks.times_us)} times"
        return f"tracking: {len(self.gaussians)} Gaussians, {times}, {self.duration_us / 1e3:.6g} ms"

    @property
    def size_bytes(self) -> int:
        """Bytes of the Gaussians and of the tracks."""
        return count_bytes([*self.gaussians.tensors().values(), *self.tracks.tensors().values()])

    def at(self, t_us: float) -> Gaussians:
        """Return the Gaussians at a time of the clip, in that time's light; times outside of it take its ends."""
        values = self.tracks.between(min(max(t_us, 0.0), self.duration_us))
        g = self.gaussians
        means, quats, colors = g.means.clone(), g.quats.clone(), g.colors.clone()
        means[self.tracks.free], quats[self.tracks.free] = values["means"], values["quats"]
        colors[self.tracks.rows] = values["colors"]
        colors *= self.light_at(t_us)  # of the instant itself: light may flicker faster than the tracks have times
        return replace(g, means=means, quats=quats, colors=colors)

    def splats(self, t_us: float) -> Splats:
        """Return what is rendered at `t_us`."""
        return self.at(t_us).splats()

    def save(self, path: Path, provenance: Provenance) -> None:
        """Write the model to one file; see `saved_model.load_model`."""
        t = self.tracks
        tracks = {**t.tensors(), "times_us": t.times_us, "free": t.free, "rows": t.rows}
        tensors = group(gaussians=self.gaussians.tensors(), tracks=tracks, **light_part(self.light))
        write_model(path, ModelFile(self.KIND, {}, tensors, provenance))

    @classmethod
    def from_file(cls, file: ModelFile, device: str) -> TrackedModel:
        """Return the model that `save` wrote. Raises KeyError, TypeError or ValueError for another version's."""
        gaussians = Gaussians.from_file({k: v.to(device) for k, v in file.part("gaussians").items()})
        tracks = Tracks(**{k: v if k == "times_us" else v.to(device) for k, v in file.part("tracks").items()})
        tracks.check(gaussians)
        return cls(gaussians, tracks, file.provenance.duration_us, light=light_of_file(file))


KINDS = {TrackedModel.KIND: TrackedModel.from_file}  # for the entry points `spike4dgs.models`
