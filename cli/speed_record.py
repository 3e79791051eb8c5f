"""`speed record` is the study's own function."""

from __future__ import annotations

from spike4dgs.studies.recorder import record as record
