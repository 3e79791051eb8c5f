"""`spacing` and `tradeoff` are the study's own functions."""

from __future__ import annotations

from spike4dgs.studies.rendering import spacing as spacing
from spike4dgs.studies.rendering import tradeoff as tradeoff
