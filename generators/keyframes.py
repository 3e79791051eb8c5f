"""Key frames on disk: one file per time, written whole or not at all, so that a killed run goes on where it was.

`still.npz` holds what does not move: the background of every view. A key file holds, for every view, only the pixels
that differ from it (flat positions and values), which is what a key costs on disk and in reading.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.generators.sensor import Float32


class KeyStore:
    """The key frames of a set of views in a folder.

    >>> store = KeyStore(Path("keys"))  # doctest: +SKIP
    >>> store.set_background(renderer.backgrounds())  # [C, H, W]  # doctest: +SKIP
    >>> for tick in store.missing(ticks):  # doctest: +SKIP
    ...     store.write(tick, renderer.keys(tick / 20_000))
    >>> clip = store.view(0, ticks)  # a lazy sequence of [H, W] for `sensor.simulate`  # doctest: +SKIP
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._background: Float32 | None = None

    @property
    def has_background(self) -> bool:
        """Whether the background is stored."""
        return self._still.is_file()

    @property
    def background(self) -> Float32:
        """What does not move, [C, H, W] float32. Raises UserError where the file is missing or damaged."""
        if self._background is None:
            self._background = _read(self._still, "background")["background"]
        return self._background

    def set_background(self, images: Float32) -> None:
        """Store the background [C, H, W]. Raises UserError for values that are not finite."""
        _check(images, self._still)
        _write(self._still, {"background": np.asarray(images, dtype=np.float32)})
        self._background = None

    def missing(self, ticks: Sequence[int]) -> list[int]:
        """The ticks without a stored key."""
        return [int(t) for t in ticks if not self._path(t).is_file()]

    def write(self, tick: int, images: Float32) -> None:
        """Store the key [C, H, W] of a tick. Raises UserError for another shape or values that are not finite."""
        still = self.background
        if images.shape != still.shape:
            raise problem(self._path(tick), f"views {still.shape}", f"{images.shape}", "render the same views")
        _check(images, self._path(tick))
        arrays: dict[str, NDArray[Any]] = {}
        for view, (image, base) in enumerate(zip(images.astype(np.float32, copy=False), still, strict=True)):
            where = np.flatnonzero(image != base)
            arrays[f"where{view}"] = where.astype(np.uint32)
            arrays[f"values{view}"] = image.ravel()[where]
        _write(self._path(tick), arrays)

    def read(self, tick: int, view: int) -> Float32:
        """One view of a key, [H, W] float32. Raises UserError where the file is missing or damaged."""
        arrays = _read(self._path(tick), f"where{view}", f"values{view}")
        image: Float32 = self.background[view].copy()
        image.ravel()[arrays[f"where{view}"]] = arrays[f"values{view}"]
        return image

    def view(self, view: int, ticks: Sequence[int]) -> _View:
        """The keys of one view as a sequence that reads a key when it is asked for."""
        return _View(self, view, ticks)

    def range(self, view: int, ticks: Sequence[int]) -> tuple[Float32, Float32]:
        """Smallest and largest radiance [H, W] of each pixel of a view over the keys."""
        low = high = self.read(ticks[0], view)
        for tick in ticks[1:]:
            image = self.read(tick, view)
            low, high = np.minimum(low, image), np.maximum(high, image)
        return low, high

    @property
    def _still(self) -> Path:
        return self.folder / "still.npz"

    def _path(self, tick: int) -> Path:
        return self.folder / f"{tick:06d}.npz"


class _View(Sequence[Float32]):
    def __init__(self, store: KeyStore, view: int, ticks: Sequence[int]) -> None:
        self._store, self._view, self._ticks = store, view, ticks

    def __len__(self) -> int:
        return len(self._ticks)

    def __getitem__(self, k: Any) -> Any:  # a key; slices are not needed
        return self._store.read(int(self._ticks[k]), self._view)


def _check(images: Float32, path: Path) -> None:
    if not np.isfinite(images).all():
        found = f"{np.count_nonzero(~np.isfinite(images))} pixels that are not"
        raise problem(path, "finite radiance", found, "correct the world or the renderer")


def _write(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    with atomic_path(path) as part:
        np.savez(part, allow_pickle=False, **arrays)


def _read(path: Path, *names: str) -> dict[str, NDArray[Any]]:
    try:
        with open(path, "rb") as f, np.load(f) as data:
            return {name: data[name] for name in names}
    except FileNotFoundError:
        raise problem(path, "a key frame", "no such file", "run the same command again") from None
    except (zipfile.BadZipFile, KeyError, ValueError, OSError, EOFError) as e:
        raise problem(path, "a key frame", f"damaged data ({e})", "delete it and run the same command again") from None
