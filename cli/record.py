"""`record` of the command line is the recorder's own function: its arguments are what a Python caller gives too."""

from __future__ import annotations

from spike4dgs.generators.recorder.record import record as record
