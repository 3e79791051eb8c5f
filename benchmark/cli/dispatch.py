"""From the arguments of `spike4dgs` to the function of a command."""

from __future__ import annotations

import difflib
import importlib
import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from typing import Any

from spike4dgs.benchmark.cli.commands import COMMANDS, SPEED, SPEED_SUMMARY, Command
from spike4dgs.benchmark.errors import UserError, problem


def load(name: str) -> Callable[..., Any]:
    """Return the function of a command, such as "submit"."""
    return _load(COMMANDS[name])


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    0: done; 1: a benchmark ran and something in it failed; 2: bad arguments or input; 3: a recording lost data;
    130: interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        return _dispatch(arguments)
    except UserError as e:
        print(f"error: {e}", file=sys.stderr)
        return 2
    except SystemExit as e:  # tyro: 0 after --help, 2 after bad arguments, whose message it has printed
        return e.code if isinstance(e.code, int) else 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _dispatch(arguments: list[str]) -> int:
    name, rest = (arguments[0], arguments[1:]) if arguments else ("--help", [])
    if name in ("-h", "--help"):
        speed = Command("", SPEED_SUMMARY, "")
        print(_overview("spike4dgs", COMMANDS | {"speed": speed}))
        return 0
    if name == "--version":
        print(version("spike4dgs"))
        return 0
    if name == "speed":
        return _speed(rest)
    command = _find(name, COMMANDS | {"speed": Command("", "", "")}, "spike4dgs")

    import tyro

    function = _load(command)
    return int(
        tyro.cli(function, args=rest, prog=f"spike4dgs {name}", description=_description(function, command)) or 0
    )


def _speed(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview("spike4dgs speed", SPEED))
        return 0
    return int(_load(_find(arguments[0], SPEED, "spike4dgs speed"))(arguments[1:]) or 0)


def _find(name: str, table: Mapping[str, Command], prog: str) -> Command:
    if name not in table:
        near = difflib.get_close_matches(name, table, 1)
        fix = f"did you mean `{prog} {near[0]}`?" if near else f"see `{prog} --help`"
        raise problem(prog, f"one of {', '.join(table)}", repr(name), fix)
    return table[name]


def _load(command: Command) -> Callable[..., Any]:
    function = _import(command.target)
    if not command.needs:
        return function
    made: Callable[..., Any] = function(*map(_imported_when_called, command.needs))
    return made


def _import(target: str) -> Callable[..., Any]:
    module, _, function = target.partition(":")
    found: Callable[..., Any] = getattr(importlib.import_module(module), function)
    return found


def _imported_when_called(target: str) -> Callable[..., Any]:
    return lambda *args, **kwargs: _import(target)(*args, **kwargs)


def _overview(prog: str, table: Mapping[str, Command]) -> str:
    width = max(map(len, table))
    lines = [f"  {name:<{width}}  {command.summary}" for name, command in table.items()]
    usage = [f"usage: {prog} COMMAND ...", "", "commands:", *lines, ""]
    return "\n".join([*usage, f"`{prog} COMMAND --help` shows a command's arguments and an example."])


def _description(function: Callable[..., Any], command: Command) -> str:
    """Return the function's docstring without its arguments, which tyro lists itself, and the example."""
    text = (inspect.getdoc(function) or command.summary).partition("\nArgs:")[0].strip()
    return f"{text}\n\nExample:\n  spike4dgs {command.example}"
