"""`spike-agreement` is the study's own function."""

from __future__ import annotations

from spike4dgs.studies.spike_agreement import spike_agreement as spike_agreement
