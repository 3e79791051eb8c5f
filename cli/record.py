"""`record`: the recorder's own function, which Python callers use with the same arguments."""

from __future__ import annotations

from spike4dgs.generators.recorder.record import record as record
