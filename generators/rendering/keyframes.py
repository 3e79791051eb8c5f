"""Key frames on disk: one file per time, written whole or not at all, so that a killed run can resume.

`still.npz` holds the static background. A key file holds, for every view, only the pixels that the renderer gives
(`MultiViewRenderer.key_arrays`): a bit for each pixel, and the values of those that are set. Pixels that a coarse key
does not give are the background; those that a finer key does not give lie on the simulator's curve (clamped
Catmull-Rom) through the next coarser keys.
"""

from __future__ import annotations

import sys
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.scene.images import gray
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.render import StaticViews
from spike4dgs.generators.sensor.light import tick_mean

T = TypeVar("T")
R = TypeVar("R")


class Clip(NamedTuple):
    """One view of a clip, dense: the input of `sensor.model.simulate`."""

    keys: Sequence[Float32]  # [H, W] each, read on access
    ticks: list[int]
    means: bool = False  # each key is the mean of its own tick, instead of the radiance at its start


class KeyStore:
    """The key frames of a set of views in a folder.

    For example::

        store = KeyStore(Path("keys"))
        store.set_static(renderer.static)
        for tick in store.missing(plan):
            store.put(tick, renderer.key_arrays(tick, plan))
        clip = store.view(0, plan)
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._loaded: StaticViews | None = None
        self._background: Float32 | None = None

    @property
    def has_static(self) -> bool:
        """True if the static background is stored."""
        return self._static_path.is_file()

    def static(self) -> StaticViews:
        """Return the static background. Raises UserError where the file is missing or damaged."""
        if self._loaded is None:
            self._loaded = StaticViews.from_arrays(read_arrays(self._static_path))
        return self._loaded

    @property
    def background(self) -> Float32:
        """Gray of the background, [C, H, W]."""
        if self._background is None:
            self._background = gray(self.static().background)
        return self._background

    def set_static(self, static: StaticViews) -> None:
        """Store the static background. Raises UserError for values that are not finite."""
        write_arrays(self._static_path, static.arrays())
        self._loaded = self._background = None

    def missing(self, plan: KeyPlan) -> list[int]:
        """Return the ticks of a plan without a stored key."""
        return [t for t in plan.ticks if not self._path(t).is_file()]

    def put(self, tick: int, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Store the key of a tick. Raises UserError for values that are not finite."""
        write_arrays(self._path(tick), arrays)

    def view(self, view: int, plan: KeyPlan) -> Clip:
        """Return one view for the simulator: radiance at the keys' ticks or, with sub-ticks, the mean of every tick."""
        instants = self.instants(view, plan)
        if plan.sub_ticks == 1:
            return instants
        return Clip(_Means(self, view, plan, instants), list(range(plan.n_ticks)), True)

    def instants(self, view: int, plan: KeyPlan) -> Clip:
        """Return the radiance of one view at all ticks with a key. Reading in ascending order is fastest."""
        return Clip(_Instants(self, view, plan), plan.ticks)

    def at(self, view: int, plan: KeyPlan) -> Callable[[int], Float32]:
        """Return a function that returns the radiance [H, W] of a view at the start of any tick, fastest in order."""
        return _Instants(self, view, plan).at

    def radiance(self, view: int, plan: KeyPlan, tick: int) -> Float32:
        """Return the radiance [H, W] at the start of any tick: a key, or on the simulator's curve between two."""
        return _Instants(self, view, plan).at(tick)

    def range(self, view: int, plan: KeyPlan) -> tuple[Float32, Float32]:
        """Return the smallest and largest radiance [H, W] of each pixel of a view over the coarse keys."""
        low = high = self.background[view]
        keys = self.instants(view, plan)
        for k in range(0, len(keys.ticks), plan.chain[0] // plan.chain[-1]):
            image = keys.keys[k]
            low, high = (image, image) if k == 0 else (np.minimum(low, image), np.maximum(high, image))
        return low, high

    def given(self, tick: int, view: int, kind: str = "") -> tuple[NDArray[np.bool_], Float32]:
        """Return the mask [H, W] of the pixels that a key gives, and their values. `kind` "mean_": means over the tick.

        Raises UserError where the file is missing or damaged.
        """
        shape = self.background[view].shape
        arrays = read_arrays(self._path(tick), f"{kind}given{view}", f"{kind}values{view}")
        mask, values = arrays[f"{kind}given{view}"], arrays[f"{kind}values{view}"]
        if len(mask) * 8 < np.prod(shape) or (bits := np.unpackbits(mask, count=int(np.prod(shape)))).sum() != len(
            values
        ):
            found = f"{len(mask)} bytes of bits, {len(values)} values"
            raise problem(self._path(tick), f"a key of {shape} pixels", found, "delete it and run again")
        return bits.reshape(shape).astype(bool), values

    @property
    def _static_path(self) -> Path:
        return self.folder / "still.npz"

    def _path(self, tick: int) -> Path:
        return self.folder / f"{tick:06d}.npz"


class _Instants(Sequence[Float32]):
    """Dense keys of one view; caches the keys of the last few coarse intervals."""

    def __init__(self, store: KeyStore, view: int, plan: KeyPlan) -> None:
        self._store, self._view, self._plan, self._ticks = store, view, plan, plan.ticks
        self._kept: dict[int, Float32] = {}

    def __len__(self) -> int:
        return len(self._ticks)

    def __getitem__(self, k: Any) -> Any:  # one key; slices are not needed
        return self.at(self._ticks[k])

    def at(self, tick: int) -> Float32:
        if tick not in self._kept:
            for old in [t for t in self._kept if t < tick - 4 * self._plan.chain[0]]:
                del self._kept[old]
            self._kept[tick] = self._read(tick)
        return self._kept[tick]

    def _read(self, tick: int) -> Float32:
        """Return the radiance at the start of a tick."""
        chain = self._plan.chain
        if tick % chain[-1]:
            return self._between(tick, chain[-1])
        level = self._plan.level(tick)
        image = self._between(tick, chain[level - 1]) if level else np.array(self._store.background[self._view])
        mask, values = self._store.given(tick, self._view)
        image[mask] = values
        return image

    def _between(self, tick: int, spacing: int) -> Float32:
        """Return the clamped Catmull-Rom curve through the keys every `spacing` ticks; see `sensor.model`."""
        first, last = tick // spacing * spacing, self._ticks[-1]
        p1, p2 = self.at(first), self.at(first + spacing)
        p0 = self.at(first - spacing) if first else None
        p3 = self.at(first + 2 * spacing) if first + 2 * spacing <= last else None
        u, d = np.float32((tick - first) / spacing), p2 - p1
        m1 = d if p0 is None else (p2 - p0) * np.float32(0.5)
        m2 = d if p3 is None else (p3 - p1) * np.float32(0.5)
        curve = p1 + u * (m1 + u * (3 * d - 2 * m1 - m2 + u * (m1 + m2 - 2 * d)))
        return np.clip(curve, np.minimum(p1, p2), np.maximum(p1, p2))


class _Means(Sequence[Float32]):
    """The mean radiance of every tick: of the curve through the instants, or rendered where the motion is too fast."""

    def __init__(self, store: KeyStore, view: int, plan: KeyPlan, instants: Clip) -> None:
        self._store, self._view, self._n, self._instants = store, view, plan.n_ticks, instants.keys

    def __len__(self) -> int:
        return self._n

    def __getitem__(self, tick: Any) -> Any:
        mean = tick_mean(self._instants.__getitem__, tick, len(self._instants) - 1)
        mask, values = self._store.given(tick, self._view, "mean_")
        mean[mask] = values
        return mean


def finite(render: Callable[[T], R], at: T, what: str) -> R:
    """Return render(at), an image or a dict of arrays; rendered once more, and that is said, where it is not finite.

    A rendering depends on its arguments alone. Yet of some 6,000 images two had one pixel that was NaN, and equalled
    the same image rendered again in all others. Where it is the world's fault the second is not finite either.
    """
    image = render(at)
    arrays: Iterable[Any] = image.values() if isinstance(image, dict) else [image]
    if all(np.isfinite(array).all() for array in arrays if array.dtype.kind == "f"):
        return image
    print(f"{what}: a pixel is no number; rendered again", file=sys.stderr)
    return render(at)


def write_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays as `.npz`; equal arrays give equal bytes. Raises UserError for values that are not finite."""
    for array in arrays.values():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            found = f"{np.count_nonzero(~np.isfinite(array))} pixels that are not"
            raise problem(path, "finite radiance", found, "correct the world or the renderer")
    with atomic_path(path) as part:
        np.savez(part, allow_pickle=False, **dict(arrays))


def read_arrays(path: Path, *names: str) -> dict[str, NDArray[Any]]:
    """Read some arrays of such a file, or all. Raises UserError where the file is missing or damaged."""
    try:
        with open(path, "rb") as f, np.load(f) as data:
            return {name: data[name] for name in names or data.files}
    except FileNotFoundError:
        raise problem(path, "arrays of a rendering", "no such file", "run the same command again") from None
    except (zipfile.BadZipFile, KeyError, ValueError, OSError, EOFError) as e:
        raise problem(
            path, "arrays of a rendering", f"damaged data ({e})", "delete it and run the same command again"
        ) from None
