"""A row of the command tables."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Command:
    """A subcommand, of one word or two: its function, a summary, and a command line that people can copy.

    A command that calls functions of other rooms `needs` them: its target is then called with them and returns the
    command's function.
    """

    target: str  # module:function
    summary: str
    example: str
    needs: tuple[str, ...] = ()  # module:function, in the order of the target's arguments
