"""The measurements of this room, in the order of the page."""

from __future__ import annotations

from collections.abc import Sequence

from spike4dgs.studies.speed_error.measurement import Measurement
from spike4dgs.studies.twins.cuts import EXPONENTIAL, EXTENT, FILTER, TRANSMITTANCE
from spike4dgs.studies.twins.networks import LOOKUP, MSDI
from spike4dgs.studies.twins.splat import BACKGROUND, GRADIENTS, PRECISION
from spike4dgs.studies.twins.splat_scale import SCALE
from spike4dgs.studies.twins.ssim import SSIM


def measurements() -> Sequence[Measurement]:
    """Return them."""
    return (PRECISION, GRADIENTS, EXPONENTIAL, EXTENT, TRANSMITTANCE, FILTER, BACKGROUND, SSIM, LOOKUP, MSDI, *SCALE)
