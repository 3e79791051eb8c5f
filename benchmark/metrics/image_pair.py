"""The input of a metric for one target: truth, prediction and moving region, in the forms that metrics take."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float64, Mask, UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.metrics.held_out_spikes import SpikeView
from spike4dgs.benchmark.metrics.ssim_window import SSIM_SIGMA, SSIM_WINDOW
from spike4dgs.benchmark.scene.images import encode_srgb

Image = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class ImagePair:
    """Linear radiance of truth and prediction [H, W] (1.0 = white), and the moving region [H, W] bool.

    `where` names the image for errors; the prediction is multiplied by `gain` before anything else. `earlier` is the
    target of the same camera before this one, `since_ms` the time between them. `spikes` are those that the held-out
    camera recorded around the target, where it did. `covisible` are the pixels [H, W] of `covisible.covisible`, where
    they are known. A truth that is not known is NaN: only metrics that do not use it
    are then computed.
    """

    truth_radiance: Image
    predicted_radiance: Image
    moving: Mask
    where: str
    gain: float = 1.0
    earlier: ImagePair | None = None
    since_ms: float = math.nan
    spikes: SpikeView | None = None
    covisible: Mask | None = None

    @cached_property
    def truth(self) -> Float64:
        """Linear truth clipped to [0, 1]."""
        return np.clip(self.truth_radiance.astype(np.float64), 0, 1)

    @cached_property
    def prediction(self) -> Float64:
        """Linear prediction times the gain, clipped to [0, 1]."""
        return np.clip(self.gain * self.predicted_radiance.astype(np.float64), 0, 1)

    @cached_property
    def truth8(self) -> UInt8:
        """Truth as shown to people: sRGB-encoded, 8 bit (computed in float64: the same on every machine)."""
        return encode_srgb(self.truth)

    @cached_property
    def prediction8(self) -> UInt8:
        """Prediction as shown to people: sRGB-encoded, 8 bit."""
        return encode_srgb(self.prediction)

    @cached_property
    def ssim(self) -> tuple[float, Float64]:
        """Mean SSIM, and the map [H, W] that it is the mean of, without a border of half a window."""
        from skimage.metrics import structural_similarity

        value, ssim_map = structural_similarity(  # type: ignore[no-untyped-call]
            self.truth,
            self.prediction,
            gaussian_weights=True,
            sigma=SSIM_SIGMA,
            use_sample_covariance=False,
            data_range=1,
            full=True,
        )
        return float(value), np.asarray(ssim_map)

    def check_image(self) -> None:
        """Raise UserError for a prediction that has one level everywhere, such as a black image."""
        if self.prediction8.min() == self.prediction8.max():
            found = f"the level {self.prediction8.flat[0]} of 255 everywhere"
            raise problem(self.where, "an image of something", found, "correct the method's fit or render")


def check_images(truth: Image, prediction: Image, moving: Mask, where: str) -> None:
    """Raise UserError unless the arrays are finite float images of one size, at least SSIM's window, and a mask."""
    if prediction.ndim != 2 or prediction.shape != truth.shape:
        raise problem(where, f"a gray image of shape {truth.shape}", f"shape {prediction.shape}", "render that size")
    if min(truth.shape) < SSIM_WINDOW:
        raise problem(where, f"at least {SSIM_WINDOW}x{SSIM_WINDOW} pixels", f"{truth.shape}", "use a larger image")
    for name, image in (("truth", truth), ("prediction", prediction)):
        if not np.issubdtype(image.dtype, np.floating):
            raise problem(where, f"a {name} in floating point", str(image.dtype), "store linear radiance, 1.0 = white")
        if bad := int(np.count_nonzero(~np.isfinite(image))):
            raise problem(where, f"a finite {name}", f"{bad} pixels that are not", "correct the program that wrote it")
    if moving.shape != truth.shape or moving.dtype != np.bool_:
        found = f"{moving.dtype} {moving.shape}"
        raise problem(where, f"a bool mask of shape {truth.shape}", found, "restore the scene's mask")
