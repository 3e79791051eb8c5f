"""`patterns` is the study's own function."""

from __future__ import annotations

from spike4dgs.studies.patterns import patterns as patterns
