"""The dynamic field and its rendering: hierarchical sampling that skips empty space."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from spike4dgs.baselines.radiance_field.field import Deformation, Field, encode_position, in_blocks
from spike4dgs.baselines.radiance_field.march import Rays, camera_rays, resample, spread, weigh
from spike4dgs.baselines.radiance_field.occupancy import Occupancy
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.runs.provenance import Provenance
from spike4dgs.benchmark.scene.cameras import Camera, border
from spike4dgs.benchmark.screen.shown import Shown
from spike4dgs.benchmark.untrusted import MAX_LENGTH, positive, whole
from spike4dgs.method.models.fitted_model import count_bytes
from spike4dgs.method.models.model_file import ModelFile, group, make_filled, write_model
from spike4dgs.method.motion.hexplane import HexPlaneShape
from spike4dgs.method.starts.plane_sweep import pixels_of
from spike4dgs.method.torch_state import one_torch_thread

_MOST_LAYERS, _MOST_SAMPLES = 64, 4096  # that a file may state; published are 8 layers and 192 samples
RAYS_AT_ONCE = 2048  # in a render: bounds memory at about 100 MB


@dataclass(frozen=True)
class FieldShape:
    """Sizes of the networks and numbers of samples."""

    depth: int
    width: int
    coarse_depth: int
    coarse_width: int
    position_frequencies: int
    direction_frequencies: int
    coarse_samples: int
    fine_samples: int
    occupancy_cells: int
    occupancy_least: float
    deformation: HexPlaneShape


@dataclass(frozen=True, eq=False)
class Bounds:
    """The extent of a scene: depths between which rays are sampled, the box of all samples, the box of the points."""

    near: float  # m along the cameras' axes
    far: float
    low: Tensor  # [3] m, the corners of the box of all samples of the training views
    high: Tensor  # [3]
    points_low: Tensor  # [3] m, the corners of the box that the deformation's planes lie in
    points_high: Tensor  # [3]
    scale: float  # m, the unit of densities (1 / scale) and movements


@dataclass(frozen=True, eq=False)
class Samples:
    """K samples of R rays: row and column in a table [R, n], and their canonical points."""

    ray: Tensor  # [K] int64
    column: Tensor  # [K] int64
    points: Tensor  # [K, 3] in [-1, 1]

    def and_also(self, others: Samples) -> Samples:
        """Return these samples and others of the same rays."""
        pairs = zip((self.ray, self.column, self.points), (others.ray, others.column, others.points), strict=True)
        return Samples(*(torch.cat(pair) for pair in pairs))


class DynamicField(nn.Module):
    """A coarse and a fine canonical field, one deformation before both, and the grid of what is empty."""

    def __init__(self, shape: FieldShape, bounds: Bounds, brightest: float, generator: torch.Generator) -> None:
        super().__init__()
        self.shape, self.bounds = shape, bounds
        encoding = shape.position_frequencies, shape.direction_frequencies, brightest, generator
        self.coarse = Field(shape.coarse_depth, shape.coarse_width, *encoding)
        self.fine = Field(shape.depth, shape.width, *encoding)
        box = bounds.points_low, bounds.points_high
        self.deformation = Deformation(shape.deformation, *box, bounds.scale, generator)
        self.occupancy = Occupancy(bounds.low, bounds.high, shape.occupancy_cells, shape.occupancy_least)

    def parameter_groups(self) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
        """Return the parameters of both fields, of the deformation's planes, and of its layers."""
        fields: list[Tensor] = [*self.coarse.parameters(), *self.fine.parameters()]
        return fields, list(self.deformation.planes.parameters()), self.deformation.mlp()

    def trace(self, rays: Rays, t: float, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """Return the coarse and the fine field's radiance [R] along rays at t in [0, 1].

        Samples are random with a generator, and in the middles of their bins without.
        """
        device = rays.origins.device
        s, view = self.shape, encode_position(_unit(rays.directions), self.shape.direction_frequencies)
        inner = spread(len(rays), s.coarse_samples - 1, generator).to(device)
        fractions = torch.cat([inner, inner.new_ones(len(rays), 1)], 1)  # the last sample is on the opaque far plane
        samples = self._samples(rays, fractions, t, 0)
        density, value = _evaluate(self.coarse, samples, view, s.coarse_samples)
        weights = weigh(density / self.bounds.scale, self.depth(fractions), rays.lengths)
        coarse = (weights * value).sum(-1)

        u = spread(len(rays), s.fine_samples, generator).to(device)
        more = resample(fractions, weights.detach(), u)
        samples = samples.and_also(self._samples(rays, more, t, s.coarse_samples))
        fractions, order = torch.cat([fractions, more], 1).sort(dim=1, stable=True)
        both = _evaluate(self.fine, samples, view, s.coarse_samples + s.fine_samples)
        density, value = (x.gather(1, order) for x in both)
        weights = weigh(density / self.bounds.scale, self.depth(fractions), rays.lengths)
        return coarse, (weights * value).sum(-1)

    def depth(self, fractions: Tensor) -> Tensor:
        """Return depths in metres of fractions in [0, 1] between the near and the far plane."""
        return self.bounds.near + (self.bounds.far - self.bounds.near) * fractions

    def update_occupancy(self, t: float, share: float, generator: torch.Generator) -> None:
        """Evaluate a share of the occupancy grid's cells at t in [0, 1]."""

        def density(points: Tensor) -> Tensor:
            return in_blocks(self.fine.density_rows, [self._canonical(points, t)], [])[:, 0] / self.bounds.scale

        self.occupancy.update(density, share, generator)

    def _samples(self, rays: Rays, fractions: Tensor, t: float, first: int) -> Samples:
        """Return the samples at `fractions` [R, n] that need a network, as columns `first` and following."""
        points = rays.at(self.depth(fractions))
        kept = self.occupancy(points) | (fractions == 1)  # the far plane is no empty space
        ray, column = torch.nonzero(kept, as_tuple=True)
        return Samples(ray, first + column, self._canonical(points[kept], t))

    def _canonical(self, points: Tensor, t: float) -> Tensor:
        """Return canonical points [K, 3] in [-1, 1] of points [K, 3] m at t; where nothing moves they stay."""
        index = torch.nonzero(self.occupancy.moves(points))[:, 0]
        moved = points.index_copy(0, index, self.deformation(points[index], t))
        return 2 * (moved - self.occupancy.low) / (self.occupancy.high - self.occupancy.low) - 1


def _unit(directions: Tensor) -> Tensor:
    return directions / directions.norm(dim=-1, keepdim=True)


def _evaluate(field: Field, samples: Samples, view: Tensor, columns: int) -> tuple[Tensor, Tensor]:
    """Return density and value, each [R, columns], of a field at the samples, for encoded views [R, E]; 0 elsewhere."""
    out = in_blocks(field.rows, [samples.points, view[samples.ray]], list(field.parameters()))  # [K, 2]
    full = out.new_zeros(len(view), columns, 2).index_put((samples.ray, samples.column), out)
    return full[..., 0], full[..., 1]


def bounds_of(cameras: Iterable[Camera], points: Float32, low: Tensor, high: Tensor, scale: float) -> Bounds:
    """Return near and far from the depths of the points [N, 3] in view, outliers left out, with a margin, and boxes.

    0.5 % of the points at either end are left out, as a plane sweep has outliers; the margin is a twentieth of the
    range. `low`, `high` and `scale` are the extent's.
    """
    depths, corners = [], []
    for camera in cameras:
        inside, _, _, z = pixels_of(camera, points.astype(np.float64))
        depths.append(z[inside])
    a, b = np.quantile(np.concatenate(depths), [0.005, 0.995])
    near, far = max(a - 0.05 * (b - a), 0.5 * a), b + 0.05 * (b - a) + 1e-3 * scale
    for camera in cameras:
        uv = border(camera)  # not its corners alone: a lens may see farthest between them
        corners += [camera.unproject(uv, np.full(len(uv), z)) for z in (near, far)]
    box = np.concatenate(corners)

    def tensor(a: NDArray[np.float64]) -> Tensor:
        return torch.as_tensor(a, dtype=torch.float32)

    return Bounds(float(near), float(far), tensor(box.min(0)), tensor(box.max(0)), low, high, scale)


@dataclass(frozen=True, eq=False, repr=False)
class RadianceModel(Shown):
    """A fitted field as a model: renders a camera at a time."""

    KIND: ClassVar = "radiance-field"

    field: DynamicField
    duration_us: float
    device: str
    cameras: tuple[Camera, ...] = ()  # the training cameras, as the fit had them; not saved

    def _about(self) -> str:
        return f"radiance field: {self.size_bytes / 1e6:.1f} MB, {self.duration_us / 1e3:.6g} ms, on {self.device}"

    @property
    def size_bytes(self) -> int:
        """Bytes of the networks, the planes and the grid."""
        return count_bytes(self.field.state_dict().values())

    @torch.no_grad()
    def render(self, camera: Camera, t_us: float) -> Float32:
        """Return gray linear radiance [H, W] float32 of `camera` at `t_us`; times outside the clip take its ends."""
        t = min(max(t_us / self.duration_us, 0.0), 1.0)
        rays = camera_rays(camera, self.device)
        with one_torch_thread():
            parts = [
                self.field.trace(rays[slice(a, a + RAYS_AT_ONCE)], t, None)[1]
                for a in range(0, len(rays), RAYS_AT_ONCE)
            ]
        return torch.cat(parts).view(camera.height, camera.width).cpu().numpy()

    def save(self, path: Path, provenance: Provenance) -> None:
        """Write the model to one file; see `saved_model.load_model`."""
        field = self.field
        bounds = {k: v.tolist() if isinstance(v, Tensor) else v for k, v in vars(field.bounds).items()}
        config = {"shape": asdict(field.shape), "bounds": bounds, "brightest": field.fine.brightest}
        write_model(path, ModelFile(self.KIND, config, group(field=field.state_dict()), provenance))

    @classmethod
    def from_file(cls, file: ModelFile, device: str) -> RadianceModel:
        """Return the model that `save` wrote.

        Raises KeyError, TypeError, ValueError or RuntimeError for another version's.
        """
        config: dict[str, Any] = dict(file.config)
        for key in ("depth", "coarse_depth", "position_frequencies", "direction_frequencies"):
            whole(config["shape"][key], 0, _MOST_LAYERS)
        for key in ("coarse_samples", "fine_samples"):
            whole(config["shape"][key], 1, _MOST_SAMPLES)
        planes = {**config["shape"]["deformation"], "spatial": tuple(config["shape"]["deformation"]["spatial"])}
        shape = FieldShape(**{**config["shape"], "deformation": HexPlaneShape(**planes)})
        values: dict[str, Any] = {k: torch.tensor(v) if isinstance(v, list) else v for k, v in config["bounds"].items()}
        numbers = (*(values[key] for key in ("near", "far", "scale")), config["brightest"])
        near, far, _, brightest = (positive(value, MAX_LENGTH) for value in numbers)
        if near >= far:
            raise ValueError(f"samples from {near:g} to {far:g} m")
        field = make_filled(
            lambda: DynamicField(shape, Bounds(**values), brightest, torch.Generator()), file.part("field")
        )
        return cls(field.to(device), file.provenance.duration_us, device)


KINDS = {RadianceModel.KIND: RadianceModel.from_file}  # for the entry points `spike4dgs.models`
