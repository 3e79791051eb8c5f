"""A row of the command tables."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Command:
    """A subcommand, of one word or two: its function, a summary, and a command line that people can copy."""

    target: str  # module:function, of cli/
    summary: str
    example: str
    seed_bits: int = 63  # the length of its seeds: no entry of the leaderboard may have longer ones
