"""The measurements of this room, in the order of the page."""

from __future__ import annotations

from collections.abc import Sequence

from spike4dgs.studies.speed_error.measurement import Measurement
from spike4dgs.studies.twins.fits import FITS
from spike4dgs.studies.twins.images import MAKERS, NUMBERS, STACKS


def measurements() -> Sequence[Measurement]:
    """Return them."""
    return (MAKERS, STACKS, NUMBERS, *FITS)
