"""The model that the one trainer fits: Gaussians and how they move, in memory and in a file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spike4dgs.benchmark.arrays import Float32, UInt8
from spike4dgs.benchmark.runs.provenance import Provenance
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.screen.shown import Shown
from spike4dgs.benchmark.untrusted import MAX_LENGTH, MAX_SIDE, MAX_TICKS, number, positive, shown, whole
from spike4dgs.method.array_path import ArrayPath
from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.models.model_file import (
    BACKGROUND,
    ModelFile,
    from_file_names,
    group,
    make_filled,
    motion_settings,
    to_file_names,
    write_model,
)
from spike4dgs.method.motion.base import Extent, Motion
from spike4dgs.method.motion.table import motion_named
from spike4dgs.method.pose_refinement import refine_pose
from spike4dgs.method.settings import Settings, make_settings
from spike4dgs.method.splat import Splats, Views, render
from spike4dgs.method.splat.background import Repeated, join
from spike4dgs.method.splat.types import PixelFilter
from spike4dgs.method.torch_state import one_torch_thread
from spike4dgs.method.training_views.light_layers import factor_at, lit

_MOST_OF_ANYTHING = 4096  # that a file's settings may ask for


@dataclass(frozen=True, eq=False)
class MotionSpec:
    """The source of a motion model: with it and the model's state, the model can be built again."""

    name: str  # as `motion.table.motion_named` knows it
    extent: Extent
    settings: Settings  # the motion's own

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        e = self.extent
        extent = {"low": e.low.tolist(), "high": e.high.tolist(), "scale": e.scale, "n_ticks": e.n_ticks}
        return {"name": self.name, "extent": {**extent, "width": e.width}, "settings": asdict(self.settings)}

    @classmethod
    def from_dict(cls, value: Mapping[str, Any], where: str) -> MotionSpec:
        """Return the spec that `as_dict` gave, or an earlier version's.

        Raises UserError for unknown settings, and KeyError, TypeError or ValueError for values that are none.
        """
        e = dict(value["extent"])
        low, high = (torch.tensor([number(v, -MAX_LENGTH, MAX_LENGTH) for v in e.pop(key)]) for key in ("low", "high"))
        scale, ticks = positive(e.pop("scale"), MAX_LENGTH), whole(e.pop("n_ticks"), 1, MAX_TICKS)
        extent = Extent(low, high, scale, ticks, whole(e.pop("width"), 1, MAX_SIDE))
        if e or len(low) != 3 or len(high) != 3:
            raise ValueError(f"an extent of low, high, scale, n_ticks and width, and not {shown(value['extent'])}")
        defaults = motion_named(value["name"]).defaults
        settings = make_settings(motion_settings(dict(value["settings"]), defaults), where, defaults)
        for setting in asdict(settings).values():
            if type(setting) is int:  # of layers, levels, features: loops have so many turns
                whole(setting, 0, _MOST_OF_ANYTHING)
        return cls(value["name"], extent, settings)


class GaussianModel(Shown):
    """A model that renders what its `splats` are at a time."""

    duration_us: float
    device: str
    pixel_filter: PixelFilter = PixelFilter()  # that it was fitted with
    light: Tensor | None = None  # factors of the light over equal parts of the clip [n]

    def splats(self, t_us: float) -> Splats:
        """Return what is rendered at `t_us`."""
        raise NotImplementedError

    def light_at(self, t_us: float) -> float:
        """Return the light's factor at a time, linear between the middles of the parts of `light`; else 1."""
        if self.light is None:
            return 1.0
        return factor_at(self.light.double().cpu().numpy(), t_us / self.duration_us)

    def image(self, image: Tensor, views: Views) -> Tensor:
        """Return gray radiance [V, H, W] of rendered channels [V, H, W, F]."""
        return image[..., 0]

    def rendered(self, splats: Splats, views: Views) -> Tensor:
        """Return gray radiance [V, H, W] of what `splats` returns, through the model's pixel filter."""
        return self.image(render(splats, views, self.pixel_filter).image, views)

    @torch.no_grad()
    def render(self, camera: Camera, t_us: float) -> Float32:
        """Return gray linear radiance [H, W] float32 of `camera` at `t_us`; times outside the clip take its ends."""
        views = Views.from_cameras([camera], device=self.device)
        with one_torch_thread():
            return self._render(views, t_us)[0].clamp(min=0).cpu().numpy()

    def _render(self, view: Views, t_us: float) -> Tensor:
        return self.rendered(self.splats(t_us), view)

    def refine(self, camera: Camera, image: Float32, background: NDArray[np.bool_], t_us: float) -> Camera:
        """Return the camera near `camera` whose render is most like `image` [H, W]; see `refine_pose`."""
        with torch.no_grad():
            splats = self.splats(t_us)
        _, z = camera.project(splats.means.double().cpu().numpy())
        depth_m = float(np.median(z[z > 0])) if (z > 0).any() else 1.0
        return refine_pose(lambda v: self.rendered(splats, v), camera, image, background, depth_m, device=self.device)


@dataclass(frozen=True, eq=False, repr=False)
class FittedModel(GaussianModel):
    """Gaussians and how they move, and others that do not."""

    KIND: ClassVar = "gaussians"

    pieces: tuple[Gaussians, ...]  # of equal parts of the clip, one after the other
    background: Gaussians  # none unless the fit froze some
    motion: Motion
    duration_us: float
    device: str
    spec: MotionSpec
    cameras: tuple[Camera, ...] = ()  # the training cameras, as the fit left them; not saved
    pixel_filter: PixelFilter = PixelFilter()  # that it was fitted with
    estimates: Mapping[str, Tensor] = field(default_factory=dict)  # the supervision's, beside the scene; not saved
    light: Tensor | None = None  # factors of all light, or of the lamp's layer, over equal parts of the clip [n]
    path: ArrayPath | None = None  # of the array, in whose frame cameras are, through the Gaussians' world

    def _about(self) -> str:
        moving = ", ".join(str(len(g)) for g in self.pieces)
        background = f" and {len(self.background)} of a background" if len(self.background) else ""
        return f"{self.spec.name}: {moving} Gaussians{background}, {self.duration_us / 1e3:.6g} ms, on {self.device}"

    def _thumbnails(self) -> Iterator[tuple[str, UInt8]]:
        """Yield a render of the first training camera in the middle of the clip."""
        for camera in self.cameras[:1]:
            yield f"{camera.id}, middle of the clip", encode_srgb(self.render(camera, self.duration_us / 2))

    @property
    def size_bytes(self) -> int:
        """Bytes of the Gaussians and of the motion model."""
        tensors = [t for g in (*self.pieces, self.background) for t in g.tensors().values()]
        return count_bytes([*tensors, *self.motion.state_dict().values()])

    def _render(self, view: Views, t_us: float) -> Tensor:
        """Render one view [1, H, W]; the same bits with the background kept from an earlier time as without."""
        still = self._repeated.in_view(view) if len(self.background) and not self.path else None
        if still is None:
            channels = render(self._all(t_us), view, self.pixel_filter).image
        else:
            channels = still.render(self._moving(t_us), [0]).image
        image = self.image(channels, view)
        if self.light is None:
            return image
        factor = self.light_at(t_us)
        return lit(image, channels, factor) if self._layered else image * factor

    @property
    def _layered(self) -> bool:
        """Whether colours have a layer of a lamp, see `light_layers`."""
        return self.light is not None and self.background.colors.shape[1] == 2

    def splats(self, t_us: float) -> Splats:
        """Return what is rendered at `t_us`, in the frame of the array; that time's light is in the gray values."""
        splats = self._all(t_us)
        if self.light is None or not (self._layered or splats.colors.shape[1] == 1):
            return splats  # what a network decodes is no gray value: its image is lit
        factor, colors = self.light_at(t_us), splats.colors
        gray = lit(colors[:, :1], colors[:, None], factor) if self._layered else colors * factor
        return Splats(*splats.geometry, gray)

    def _all(self, t_us: float) -> Splats:
        moving = self._moving(t_us)
        splats = join(self._repeated.splats, moving) if len(self.background) else moving
        return self.path.carried(splats, self._share(t_us)) if self.path else splats

    def _share(self, t_us: float) -> float:
        """Return a time in [0, 1] of the clip."""
        return min(max(t_us / self.duration_us, 0.0), 1.0)

    def _moving(self, t_us: float) -> Splats:
        t, count = self._share(t_us), len(self.pieces)
        piece = min(int(t * count), count - 1)
        return self.motion.splats(self.pieces[piece], t * count - piece)

    @cached_property
    def _repeated(self) -> Repeated:
        return Repeated(self.background.splats(), self.pixel_filter)

    def image(self, image: Tensor, views: Views) -> Tensor:
        """Return gray radiance [V, H, W] of rendered channels [V, H, W, F]."""
        return self.motion.image(image, views)

    def save(self, path: Path, provenance: Provenance) -> None:
        """Write the model to one file; see `saved_model.load_model`."""
        pieces = {f"piece{i}": to_file_names(g.tensors()) for i, g in enumerate(self.pieces)}
        background = {BACKGROUND: to_file_names(self.background.tensors())}
        own = {} if self.path is None else {"path": self.path.tensors()}
        tensors = group(**pieces, **background, motion=self.motion.state_dict(), **light_part(self.light), **own)
        config = {"motion": self.spec.as_dict(), "pieces": len(pieces), "filter": asdict(self.pixel_filter)}
        write_model(path, ModelFile(self.KIND, config, tensors, provenance))

    @classmethod
    def from_file(cls, file: ModelFile, device: str) -> FittedModel:
        """Return the model that `save` wrote.

        Raises KeyError, TypeError, ValueError, RuntimeError or UserError for another version's.
        """
        spec = MotionSpec.from_dict(file.config["motion"], file.provenance.name)
        motion = make_filled(
            lambda: motion_named(spec.name)(spec.extent, spec.settings, torch.Generator()), file.part("motion")
        )
        count = whole(file.config["pieces"], 1, len(file.tensors))
        *pieces, background = (
            Gaussians.from_file({k: v.to(device) for k, v in from_file_names(file.part(part)).items()})
            for part in (*(f"piece{i}" for i in range(count)), BACKGROUND)
        )
        duration_us, found = file.provenance.duration_us, _filter(file.config.get("filter", {}))
        light = light_of_file(file)
        path = ArrayPath.from_tensors(tensors) if (tensors := file.part("path")) else None
        own: dict[str, Any] = {"pixel_filter": found, "light": light, "path": path}
        made = cls(tuple(pieces), background, motion.to(device), duration_us, device, spec, **own)
        for piece in range(count):  # else what the motion lacks of one would only be missed at a render
            made.splats(duration_us * piece / count)
        return made


def light_part(light: Tensor | None) -> dict[str, dict[str, Tensor]]:
    """Return the part of a model's file that holds the factors [n] of its light, where it has any."""
    return {} if light is None else {"light": {"factors": light}}


def light_of_file(file: ModelFile) -> Tensor | None:
    """Return the factors [n] of the light that a model's file has, if any. Raises KeyError or ValueError for others."""
    if not (tensors := file.part("light")):
        return None
    factors = tensors["factors"]
    if factors.ndim != 1 or not 0 < len(factors) <= MAX_TICKS or not (factors.isfinite() & (factors >= 0)).all():
        raise ValueError("finite factors of the light from 0 up, in one row")
    return factors.float()


def _filter(value: Mapping[str, Any]) -> PixelFilter:
    """Return the filter that a file names, or the customary one where it names none, as earlier versions' do."""
    made = PixelFilter(**value)
    if type(made.compensated) is not bool:
        raise ValueError(f"a filter with `compensated` true or false, and not {shown(made.compensated)}")
    return replace(made, variance=number(made.variance, 0, MAX_SIDE))


def count_bytes(tensors: Iterable[Tensor]) -> int:
    """Return the bytes that tensors take in a file."""
    return sum(t.numel() * t.element_size() for t in tensors)
