"""The `spike4dgs` command line."""

from spike4dgs.benchmark.cli.commands import COMMANDS, SPEED, Command
from spike4dgs.benchmark.cli.dispatch import load, main

__all__ = ["COMMANDS", "SPEED", "Command", "load", "main"]
