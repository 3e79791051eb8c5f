"""From the arguments of `spike4dgs` to the function of a command."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import io
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib.metadata import version
from types import MappingProxyType
from typing import Any, get_args, get_type_hints

from spike4dgs.benchmark.errors import UserError, problem, unknown
from spike4dgs.cli.command import Command
from spike4dgs.cli.commands import COMMANDS, GROUPS

_MOST = 1e12  # of a number on the command line
_NARROWEST = 60  # characters of a line of the overview


def load(name: str) -> Callable[..., Any]:
    """Return the function of a command, such as "submit"."""
    return _load(COMMANDS[name])


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    0: done; 1: the command ran, but something in it failed; 2: bad arguments or input, or damage found; 3: a recording
    lost data; 130: interrupted; 141: the reader of the output closed it, as `| head` does.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a name that a pipe's code page lacks is escaped, and ends nothing
            stream.reconfigure(errors="backslashreplace")
    try:
        code = _dispatch(arguments)
        sys.stdout.flush()
        return code
    except UserError as e:
        print(f"error: {e}", file=sys.stderr)
        return 2
    except SystemExit as e:  # tyro: 0 after --help, 2 after bad arguments, whose message it has printed
        return e.code if isinstance(e.code, int) else 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes it once more at its end
        return 141
    except OSError as e:
        from spike4dgs.benchmark.files import failure_of

        if (failure := failure_of(e, str(e.filename or "the disk"))) is None:
            raise
        print(f"error: {failure}", file=sys.stderr)
        return 2


_THREADS = re.compile(r"\s*\+?0*[1-9][0-9]{0,3}\s*(,\s*\+?0*[1-9][0-9]{0,3}\s*)*")  # one number for each level of loops


def _check_environment() -> None:
    """Raise UserError for a number of threads that OpenMP would pass over, with a line that nobody understands."""
    value = os.environ.get("OMP_NUM_THREADS", "1")
    if not _THREADS.fullmatch(value):
        raise problem("OMP_NUM_THREADS", "a number of threads, 1 to 9999", repr(value[:40]), "correct or unset it")


def _check_names(arguments: Iterable[str]) -> None:
    """Raise UserError for names that are no text: records and pages are UTF-8, and OpenEXR takes no other names.

    Raises one for a working folder that was removed, too.
    """
    try:
        folder = os.getcwd()
    except FileNotFoundError:
        raise problem("working folder", "a folder", "a removed one", "change to one that exists") from None
    for where, name in (*(("argument", a) for a in arguments), ("working folder", folder)):
        try:
            name.encode()
        except UnicodeEncodeError:
            shown = ascii(os.fsencode(name)[:80])[1:]
            raise problem(where, "a name in UTF-8", shown, "rename the folder, or link to it by another name") from None


def _dispatch(arguments: list[str]) -> int:
    _check_environment()
    _check_names(arguments)
    name, rest = (arguments[0], arguments[1:]) if arguments else ("--help", [])
    if name in ("-h", "--help"):
        print(_overview("spike4dgs", COMMANDS, GROUPS))
        return 0
    if name == "--version":
        print(version("spike4dgs"))
        return 0
    if verbs := {two: c for two, c in COMMANDS.items() if two.startswith(f"{name} ")}:
        if rest and f"{name} {rest[0]}" in verbs:
            name, rest = f"{name} {rest[0]}", rest[1:]
        elif name not in COMMANDS:
            return _verbs(name, rest, verbs)
    command = _find(name, COMMANDS, "spike4dgs")

    import tyro

    function = _load(command)
    bounded, about = _bounded(function, command.seed_bits), _description(function, command)
    return int(tyro.cli(bounded, args=rest, prog=f"spike4dgs {name}", description=about) or 0)


def _verbs(name: str, rest: list[str], verbs: Mapping[str, Command]) -> int:
    """Show the verbs of a command of two words. Raises UserError for one that it has not."""
    table = {two.removeprefix(f"{name} "): command for two, command in verbs.items()}
    if rest and rest[0] not in ("-h", "--help"):
        _find(rest[0], table, f"spike4dgs {name}")
    print(_overview(f"spike4dgs {name}", table))
    return 0


def _bounded(function: Callable[..., Any], seed_bits: int) -> Callable[..., Any]:
    """Return the same command; it raises UserError for numbers that no command takes: NaN, infinity, 1e300, seed -1."""

    from tyro.conf import OmitArgPrefixes

    from spike4dgs.benchmark.untrusted import shown

    flat = {n for n, t in get_type_hints(function, include_extras=True).items() if OmitArgPrefixes in get_args(t)}

    @functools.wraps(function)
    def bounded(*args: Any, **kwargs: Any) -> Any:
        for name, value in inspect.signature(function).bind(*args, **kwargs).arguments.items():
            for option, number in _numbers("" if name in flat else name.replace("_", "-"), value):
                if option.endswith("seed"):
                    if not 0 <= number < 2**seed_bits:
                        expected = f"a seed from 0 up, of {seed_bits} bits"
                        raise problem(f"--{option}", expected, shown(number), "choose another seed")
                elif not abs(number) <= _MOST:
                    expected = f"a number from {-_MOST:g} to {_MOST:g}"
                    raise problem(f"--{option}", expected, shown(number), "correct it")
        return function(*args, **kwargs)

    return bounded


def _numbers(option: str, value: Any) -> Iterator[tuple[str, float]]:
    """Yield the numbers of an option, which may be a group of options, each with its name.

    Without a prefix ("") groups within a group have none either.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            name, inner = field.name.replace("_", "-"), getattr(value, field.name)
            if option:
                name = f"{option}.{name}"
            elif dataclasses.is_dataclass(inner):
                name = ""
            yield from _numbers(name, inner)
    elif isinstance(value, tuple | list):
        for item in value:
            yield from _numbers(option, item)
    elif isinstance(value, int | float):
        yield option, value


def _find(name: str, table: Mapping[str, Command], prog: str) -> Command:
    if name not in table:
        raise unknown(prog, name, table, f"`{prog} --help`")
    return table[name]


def _load(command: Command) -> Callable[..., Any]:
    module, _, function = command.target.partition(":")
    found: Callable[..., Any] = getattr(importlib.import_module(module), function)
    text, heading, entries = (inspect.getdoc(found) or "").partition("\nArgs:\n")
    found.__doc__ = text + heading + re.sub(r"\n {8}", " ", entries)  # tyro breaks lines where an entry has them
    return found


def _overview(prog: str, table: Mapping[str, Command], groups: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return the commands with their summaries, below the headings of `groups`; lines fit the terminal."""
    width = max(map(len, table))
    line_width = max(shutil.get_terminal_size().columns, _NARROWEST)

    def lines(names: Iterable[str]) -> Iterator[str]:
        for name in names:
            first, rest = f"  {name:<{width}}  ", " " * (width + 4)
            yield from textwrap.wrap(table[name].summary, line_width, initial_indent=first, subsequent_indent=rest)

    listed = [f"usage: {prog} COMMAND ..."]
    for heading, words in (groups or {"commands": " ".join(table)}).items():
        found = [n for word in words.split() for n in table if n.partition(" ")[0] == word] if groups else list(table)
        listed += ["", f"{heading}:", *lines(found)]
    return "\n".join([*listed, "", f"`{prog} COMMAND --help` shows a command's arguments and an example."])


def _description(function: Callable[..., Any], command: Command) -> str:
    """Return the function's docstring without its arguments, which tyro lists itself, and the example."""
    text = (inspect.getdoc(function) or command.summary).partition("\nArgs:")[0].strip()
    return f"{text}\n\nExample:\n  spike4dgs {command.example}"
