"""`speed render` is the study's own function."""

from __future__ import annotations

from spike4dgs.studies.saved_models import render as render
