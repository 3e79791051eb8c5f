"""`report hard-cases` is the study's own function."""

from __future__ import annotations

from spike4dgs.studies.hard_cases import hard_cases as hard_cases
