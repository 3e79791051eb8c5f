"""`speed images` is the study's own function."""

from __future__ import annotations

from spike4dgs.studies.images import images as images
