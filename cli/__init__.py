"""The `spike4dgs` command line."""

from spike4dgs.cli.command import Command
from spike4dgs.cli.commands import COMMANDS
from spike4dgs.cli.dispatch import load, main
from spike4dgs.cli.measurements import SPEED

__all__ = ["COMMANDS", "SPEED", "Command", "load", "main"]
