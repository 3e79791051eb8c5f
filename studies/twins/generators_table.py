"""The measurements of this room, in the order of the page."""

from __future__ import annotations

from collections.abc import Sequence

from spike4dgs.studies.speed_error.measurement import Measurement
from spike4dgs.studies.twins.render_scale import SCALE
from spike4dgs.studies.twins.rendering import SAVINGS, SOFT_LIGHT, SPACING
from spike4dgs.studies.twins.sensor import SENSOR


def measurements() -> Sequence[Measurement]:
    """Return them."""
    return (SENSOR, SPACING, SAVINGS, SOFT_LIGHT, *SCALE)
