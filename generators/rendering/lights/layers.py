"""Lamps that flash: the light of steady lamps and of flashing ones is rendered apart, and added with the brightness.

    radiance(t) = steady(t) + brightness(t) * flashing(t)

Light adds up, so this is exact at each tick, however short a flash is: keys follow the motion alone. Each of the two is
rendered as any world is. Their views follow each other in static views and in key frames: of C cameras, view v of the
steady light is number v, and of the flashing light number C + v.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.keyframes import Clip, KeyStore
from spike4dgs.generators.rendering.moving_array.renderer import MovingArrayRenderer, along
from spike4dgs.generators.rendering.render import MultiViewRenderer, StaticViews
from spike4dgs.generators.rig import ArrayPath
from spike4dgs.generators.sensor.light import STEADY, FlickeringInstants, FlickeringMeans, Light
from spike4dgs.generators.worlds import WorldScene
from spike4dgs.generators.worlds.base import Flash

_INSTANTS = 16  # of a tick, whose mean is the brightness of the tick


class LayeredRenderer:
    """Renders a world with a flash like a `MultiViewRenderer`; static views and keys have twice as many views."""

    def __init__(
        self, world: WorldScene, cameras: Sequence[Camera], *, static: StaticViews | None = None, **settings: Any
    ) -> None:
        """Load the world twice; for `settings` see `MultiViewRenderer`."""
        assert world.flash
        self.world, self.cameras, self._flash, n = world, tuple(cameras), world.flash, len(cameras)
        parts = [static.views(range(k, k + n)) for k in (0, n)] if static else [None, None]
        self._layers = [
            MultiViewRenderer(layer, cameras, static=part, **settings)
            for layer, part in zip(world.layers, parts, strict=True)
        ]
        steady = self._layers[0]
        self.object_masks, self.moving_masks = steady.object_masks, steady.moving_masks
        self.depths, self.geometry = steady.depths, steady.geometry

    def static_at(self, pixels: NDArray[Any], background: bool = True) -> tuple[NDArray[Any], ...]:
        """Return the static views at flat pixels, as `MultiViewRenderer.static_at`."""
        size = int(np.prod(self._layers[0].shape))
        layers = [
            layer.static_at(pixels[pixels // size == k] % size, background) for k, layer in enumerate(self._layers)
        ]
        return tuple(np.concatenate(both) for both in zip(*layers, strict=True))  # pixels ascend

    def keys(self, t_s: float) -> NDArray[Any]:
        """Return the views at `t_s`."""
        return self._sum(t_s, *(layer.keys(t_s) for layer in self._layers))

    def key_arrays(self, tick: int, plan: KeyPlan) -> dict[str, NDArray[Any]]:
        """Return the arrays of a tick for `FlashStore`, as `MultiViewRenderer.key_arrays`."""
        found = {}
        for k, layer in enumerate(self._layers):
            for name, array in layer.key_arrays(tick, plan).items():
                kind = name.rstrip("0123456789")
                found[f"{kind}{int(name[len(kind) :]) + k * len(self.cameras)}"] = array
        return found

    def crn_frames(self, t_s: float) -> NDArray[Any]:
        """Return all pixels traced at `t_s` with the random numbers of `keys`."""
        return self._sum(t_s, *(layer.crn_frames(t_s) for layer in self._layers))

    def _sum(self, t_s: float, steady: NDArray[Any], flashing: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(steady + np.float32(self._flash.brightness(t_s)) * flashing)


Renderer = MultiViewRenderer | LayeredRenderer | MovingArrayRenderer


def path_renderer(
    world: WorldScene, cameras: Sequence[Camera], *, path: ArrayPath | None = None, **settings: Any
) -> Renderer:
    """Return the renderer of whole paths of a world; `path`: the motion of the array, in steady light."""
    return (LayeredRenderer if world.flash else along(path))(world, cameras, **settings)


class _Brightness:
    """The brightness of a flash at ticks and over them."""

    def __init__(self, flash: Flash, rate_hz: int) -> None:
        self._of, self._rate_hz = flash.brightness, rate_hz

    def at(self, tick: float) -> float:
        return self._of(tick / self._rate_hz)

    def mean(self, tick: int) -> float:
        return float(np.mean([self.at(tick + (k + 0.5) / _INSTANTS) for k in range(_INSTANTS)]))


class _Sum(Sequence[Float32]):
    def __init__(self, steady: Sequence[Float32], flashing: Sequence[Float32]) -> None:
        self._parts = steady, flashing

    def __len__(self) -> int:
        return len(self._parts[0])

    def __getitem__(self, tick: Any) -> Any:  # one tick; slices are not needed
        return self._parts[0][tick] + self._parts[1][tick]


class FlashStore(KeyStore):
    """The key frames of a `LayeredRenderer`, as the radiance of its cameras' views in the light of each tick."""

    def __init__(self, folder: Path, flash: Flash) -> None:
        super().__init__(folder)
        self._flash, self._layers = flash, KeyStore(folder)

    def view(self, view: int, plan: KeyPlan) -> Clip:
        """Return one view for the simulator: the mean radiance of every tick."""
        layers = []
        for number, light in self._lights(view, plan):
            means = None if plan.sub_ticks == 1 else self._layers.view(number, plan).keys
            layers.append(FlickeringMeans(self._layers.at(number, plan), plan.n_ticks, light, means))
        return Clip(_Sum(*layers), list(range(plan.n_ticks)), True)

    def instants(self, view: int, plan: KeyPlan) -> Clip:
        """Return the radiance of one view at the start of all ticks. Reading in ascending order is fastest."""
        layers = [
            FlickeringInstants(self._layers.at(number, plan), plan.n_ticks, light)
            for number, light in self._lights(view, plan)
        ]
        return Clip(_Sum(*layers), list(range(plan.n_ticks + 1)))

    def at(self, view: int, plan: KeyPlan) -> Callable[[int], Float32]:
        """Return a function that returns the radiance [H, W] of a view at the start of any tick, fastest in order."""
        return self.instants(view, plan).keys.__getitem__

    def radiance(self, view: int, plan: KeyPlan, tick: int) -> Float32:
        """Return the radiance [H, W] at the start of any tick."""
        return self.at(view, plan)(tick)

    def range(self, view: int, plan: KeyPlan) -> tuple[Float32, Float32]:
        """Return the smallest and largest radiance [H, W] of each pixel of a view over the coarse keys."""
        at = self.at(view, plan)
        low = high = at(0)
        for tick in range(plan.chain[0], plan.n_ticks + 1, plan.chain[0]):
            low, high = np.minimum(low, image := at(tick)), np.maximum(high, image)
        return low, high

    def _lights(self, view: int, plan: KeyPlan) -> list[tuple[int, Light]]:
        """Return the number of each layer's view, and its light."""
        half = len(self.background) // 2
        return [(view, STEADY), (half + view, _Brightness(self._flash, plan.rate_hz))]


def key_store(folder: Path, world: WorldScene) -> KeyStore:
    """Return the store of a world's key frames."""
    return FlashStore(folder, world.flash) if world.flash else KeyStore(folder)
