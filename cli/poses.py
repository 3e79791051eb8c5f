"""`poses` is the study's own function."""

from __future__ import annotations

from spike4dgs.studies.poses import poses as poses
