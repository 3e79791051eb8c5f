"""`report speed-error` is the study's own function."""

from __future__ import annotations

from spike4dgs.studies.speed_error.command import speed_error as speed_error
