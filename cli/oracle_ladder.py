"""`report oracle-ladder` is the study's own function."""

from __future__ import annotations

from spike4dgs.studies.oracle_ladder import oracle_ladder as oracle_ladder
