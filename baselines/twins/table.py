"""The measurements of this room, in the order of the page."""

from __future__ import annotations

from collections.abc import Sequence

from spike4dgs.baselines.twins.fits import FITS
from spike4dgs.baselines.twins.images import MAKERS, NUMBERS, STACKS
from spike4dgs.benchmark.reports.speed_error.measurement import Measurement


def measurements() -> Sequence[Measurement]:
    """Return them."""
    return (MAKERS, STACKS, NUMBERS, *FITS)
