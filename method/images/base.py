"""Image makers, the first of a recipe's four parts: each turns a window of spikes into an image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.screen.shown import Shown
from spike4dgs.benchmark.spikes.sensor_model import gathered
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.weights import FoundWeights
from spike4dgs.method.images.light import PixelLight
from spike4dgs.method.settings import Settings


@dataclass(frozen=True)
class Learned:
    """The weights of a trained part: runs with other weights are other methods."""

    sha256: str  # of the weight file
    trained_on: tuple[str, ...]  # data sets, such as scenes as ID@REVISION


def learned_from(find: Callable[[], FoundWeights], read_card: Callable[[Path], Any]) -> Learned | None:
    """Return the hash and the training data of the weights in use; None where they are missing or damaged.

    A fit will say which of the two.
    """
    try:
        found = find()
        return Learned(found.sha256, read_card(found.path).trained_on)
    except UserError:
        return None


def _no_rate(stream: SpikeStream, tick: int, settings: Any) -> Float32:
    raise NotImplementedError("an image maker without `rate` makes its images in a subclass")


@dataclass(frozen=True, kw_only=True, repr=False)
class ImageMaker(Shown):
    """A named way from spikes to images. A table of recipes' parts holds these.

    `rate` returns spikes per tick [H, W] float32 at the start of a tick. A pixel's own rate can be corrected by its
    calibration afterwards. A maker that looks at neighbours needs the calibration before: `corrected` returns the rate
    that an ideal camera's pixels would have. A maker of something else than rates is a subclass with its own call.

    >>> from spike4dgs.baselines.images.tfp import TFP, TfpSettings
    >>> from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
    >>> stream = SpikeStream(pack(np.tile(np.eye(8), (25, 1, 1))), 8, 8, 20_000.0)  # 25 ticks, the diagonal fires
    >>> TFP(stream, ticks=[10, 12], gain=0.5).shape
    (2, 8, 8)
    >>> TFP.with_settings(TfpSettings(half_window=5))(stream, [10], gain=0.5)[0, 0, :2]
    array([2., 0.], dtype=float32)
    """

    name: str
    definition: str = ""  # may refer to fields of the settings by their names
    source: str = ""
    rate: Callable[..., Float32] = _no_rate  # of a stream, a tick and the settings
    settings: Settings = Settings()  # the maker's own numbers (prefix `image_maker`)
    learned: Callable[[], Learned | None] = lambda: None  # the weights in use; None: nothing is learned, or none there
    corrected: Callable[[SpikeStream, int, Calibration], Float32] | None = None
    without_dark: bool = False  # `rate` has lost the mean dark rate already, as a network learns from ground truth
    # Rate, the spans [2, H, W] that it is a mean over, and their doubts, see `with_spans`; None: rates are of instants.
    rate_over: Callable[..., tuple[Float32, Float32, Float32 | None]] | None = None
    knows_light: bool = False  # `rate` and `rate_over` take `light`, see `images.light`; else they take it as steady
    made_on: Callable[[str], ImageMaker] | None = None  # the maker on a device; None: there is no choice of device
    label: str | None = None  # in descriptions of recipes, after "images"; None: the name
    given: tuple[str, ...] = ()  # of `benchmark.method.GIVEN`, what the images are made of if not of spikes

    def _about(self) -> str:
        return f"{self.name}: {self.definition}"

    def with_settings(self, settings: Settings) -> ImageMaker:
        """Return the same maker with other numbers. Raises TypeError for the settings of another maker."""
        if type(settings) is not type(self.settings):
            raise TypeError(f"{self.name} has {type(self.settings).__name__}, not {type(settings).__name__}")
        return replace(self, settings=settings)

    def on(self, device: str) -> ImageMaker:
        """Return the same maker with its network, if it has one, on `device`."""
        return self.made_on(device) if self.made_on else self

    def in_light(self, light: PixelLight) -> ImageMaker:
        """Return the same maker in light that changes, if it knows any: see `PixelLight` for its rates."""
        if not self.knows_light:
            return self
        over = self.rate_over and partial(self.rate_over, light=light)
        return replace(self, rate=partial(self.rate, light=light), rate_over=over)

    def __call__(
        self, stream: SpikeStream, ticks: Sequence[int], gain: float, camera: Calibration | None = None
    ) -> Float32:
        """Return linear radiance [n, H, W] float32 (1.0 = white) at the starts of `ticks`.

        `gain` is spikes per tick of white. `camera` corrects the images for what its pixels do to light; a dead pixel
        has seen nothing, which is not black but NaN. Raises UserError for a tick outside the clip.
        """
        images = np.empty((len(ticks), stream.height, stream.width), np.float32)
        for image, tick in zip(images, ticks, strict=True):
            _require_tick(stream, tick)
            if self.corrected and camera:
                image[:] = self.corrected(stream, tick, camera)
            else:
                image[:] = self.rate(stream, tick, self.settings)
        return self._radiance(gathered(images, stream.dead_ticks), gain, camera)

    def with_spans(
        self, stream: SpikeStream, ticks: Sequence[int], gain: float, camera: Calibration | None = None
    ) -> tuple[Float32, Float32 | None, Float32 | None]:
        """Return the images, and the span that each value is a mean over: [n, 2, H, W] in ticks from each of `ticks`.

        None: the images show instants. Last come doubts [n, 4, H, W], None where no tick is lost: a span's spikes in
        doubt at most, the radiance of one, that of the span without any, and how much more the image has.
        """
        if self.rate_over is None:
            return self(stream, ticks, gain, camera), None, None
        for tick in ticks:
            _require_tick(stream, tick)
        found = [self.rate_over(stream, tick, self.settings) for tick in ticks]

        def radiance(rates: Float32) -> Float32:
            return self._radiance(gathered(rates, stream.dead_ticks), gain, camera)

        images, doubts = radiance(np.stack([rate for rate, _, _ in found])), None
        if found[0][2] is not None:
            most, one, without = np.stack([doubt for _, _, doubt in found if doubt is not None], 1)
            low, high = radiance(without.copy()), radiance(without + one)
            doubts = np.stack([most, high - low, low, images - low], 1)
        return images, np.stack([spans for _, spans, _ in found]), doubts

    def _radiance(self, images: Float32, gain: float, camera: Calibration | None) -> Float32:
        """Return radiance from rates [n, H, W], which may be overwritten."""
        if camera is None:
            images /= gain
            return images
        if self.without_dark:
            images += camera.mean_dark
        found = images / np.float32(camera.radiance_gain) if self.corrected else camera.radiance(images)
        found[:, ~(camera.gain > 0)] = np.nan
        return found


def _require_tick(stream: SpikeStream, tick: int) -> None:
    if not 0 <= tick < stream.n_ticks:
        raise problem(stream.source, f"ticks within [0, {stream.n_ticks})", f"{tick}", "ask for another tick")


WINDOW = 41  # ticks, of Spk2ImgNet
HALF_WINDOW = WINDOW // 2


def mirrored(indices: NDArray[np.integer[Any]], n: int) -> NDArray[np.int64]:
    """Return indices into a sequence of length n that is mirrored beyond its ends, the ends repeated."""
    folded = np.asarray(indices, np.int64) % (2 * n)
    return np.minimum(folded, 2 * n - 1 - folded)


def window(stream: SpikeStream, tick: int, length: int = WINDOW) -> NDArray[np.uint8]:
    """Return the spikes of `length` ticks, an odd number, around `tick` as [length, H, W] uint8 of 0 and 1.

    Beyond its ends the clip is mirrored in time. A window that moved instead would give the image of another tick, and
    a repeated last tick would change the pixels' rates.
    """
    half = length // 2
    ticks = mirrored(np.arange(tick - half, tick + half + 1), stream.n_ticks)
    first = int(ticks.min())
    return stream.window(first, int(ticks.max()) + 1)[ticks - first]
