"""The `spike4dgs` command line."""

from spike4dgs.benchmark.cli.command import Command
from spike4dgs.benchmark.cli.commands import COMMANDS
from spike4dgs.benchmark.cli.dispatch import load, main
from spike4dgs.benchmark.cli.measurements import SPEED

__all__ = ["COMMANDS", "SPEED", "Command", "load", "main"]
