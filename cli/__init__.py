"""The `spike4dgs` command line."""

from spike4dgs.cli.command import Command
from spike4dgs.cli.commands import COMMANDS
from spike4dgs.cli.dispatch import load, main

__all__ = ["COMMANDS", "Command", "load", "main"]
