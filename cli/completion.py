"""`completion`: print a script that completes commands and their options in a shell; tyro writes it."""

from __future__ import annotations

from functools import reduce
from operator import or_
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import Positional, subcommand

from spike4dgs.cli.commands import COMMANDS
from spike4dgs.cli.dispatch import load

Shell = Literal["bash", "zsh", "fish"]


def completion(shell: Positional[Shell]) -> int:
    """Print a shell's completion script. This takes several seconds, so save the script to a file.

    bash: `spike4dgs completion bash > ~/.local/share/bash-completion/completions/spike4dgs`.
    zsh: `spike4dgs completion zsh > ~/.zfunc/_spike4dgs`, with `fpath+=~/.zfunc` before `compinit` in ~/.zshrc.
    fish: `spike4dgs completion fish > ~/.config/fish/completions/spike4dgs.fish`.

    Args:
        shell: bash, zsh or fish.
    """
    verbs: dict[str, list[Any]] = {}
    for name in COMMANDS:
        first, _, second = name.partition(" ")
        if not second or first not in COMMANDS:  # a verb of what is a command itself is not completed
            verbs.setdefault(first, []).append(Annotated[load(name), subcommand(second or first)])
    kinds = {name: reduce(or_, found) for name, found in verbs.items()}
    named = [kind if name in COMMANDS else Annotated[kind, subcommand(name)] for name, kind in kinds.items()]
    every: Any = reduce(or_, named)
    try:
        tyro.cli(every, prog="spike4dgs", args=["--tyro-print-completion", shell])
    except SystemExit as e:  # as after --help
        if e.code:
            raise
    if shell == "bash":  # file names where there is nothing to complete
        print("complete -o bashdefault -o default -F _tyro_spike4dgs spike4dgs")
    return 0
