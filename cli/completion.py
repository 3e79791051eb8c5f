"""`completion`: print a script that completes commands in a shell; everything after a command completes as files.

tyro writes such scripts too, but none for fish; with commands that load lazily theirs start Python at each Tab and
offer no file names.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from tyro.conf import Positional

from spike4dgs.cli.commands import COMMANDS

Shell = Literal["bash", "zsh", "fish"]
Words = Mapping[str, str]  # word -> what it does


def completion(shell: Positional[Shell]) -> int:
    """Print a shell's completion script. The script itself is instant: it has the commands and starts no Python.

    bash: `eval "$(spike4dgs completion bash)"` in ~/.bashrc. zsh: the same with zsh, in ~/.zshrc after `compinit`.
    fish: `spike4dgs completion fish > ~/.config/fish/completions/spike4dgs.fish`.

    Args:
        shell: bash, zsh or fish.
    """
    print(script(shell), end="")
    return 0


def script(shell: Shell) -> str:
    """Return the completion script of a shell."""
    first = {name.partition(" ")[0]: command.summary for name, command in COMMANDS.items()}
    second = {
        **verbs_of_two(),
        "completion": {name: f"the script for {name}" for name in ("bash", "zsh", "fish")},
    }
    return {"bash": _bash, "zsh": _zsh, "fish": _fish}[shell](first, second)


def verbs_of_two() -> dict[str, dict[str, str]]:
    """Return the second words of the commands that have two, with their summaries, by the first."""
    verbs: dict[str, dict[str, str]] = {}
    for name, command in COMMANDS.items():
        first, _, second = name.partition(" ")
        if second:
            verbs.setdefault(first, {})[second] = command.summary
    return verbs


def _bash(first: Words, second: Mapping[str, Words]) -> str:
    cases = [f"        {command}) words='{' '.join(words)}' ;;" for command, words in second.items()]
    lines = [
        "_spike4dgs() {",
        "    local words=''",
        '    if [ "$COMP_CWORD" -eq 1 ]; then',
        f"        words='{' '.join(first)} --help --version'",
        '    elif [ "$COMP_CWORD" -eq 2 ]; then',
        '        case "${COMP_WORDS[1]}" in',
        *cases,
        "        esac",
        "    fi",
        '    COMPREPLY=($(compgen -W "$words" -- "${COMP_WORDS[COMP_CWORD]}"))',
        "}",
        "complete -o bashdefault -o default -F _spike4dgs spike4dgs",
    ]
    return "\n".join(lines) + "\n"


def _zsh(first: Words, second: Mapping[str, Words]) -> str:
    def described(words: Words) -> str:
        return " ".join(_quoted(f"{word}:{text}") for word, text in words.items())

    cases = [f"        {command}) found=({described(words)}) ;;" for command, words in second.items()]
    lines = [
        "#compdef spike4dgs",
        "_spike4dgs() {",
        "    local -a found",
        "    if (( CURRENT == 2 )); then",
        f"        found=({described(first)})",
        "    elif (( CURRENT == 3 )); then",
        "        case $words[2] in",
        *cases,
        "        esac",
        "    fi",
        "    if (( $#found )); then _describe word found; else _files; fi",
        "}",
        'if [ "$funcstack[1]" = _spike4dgs ]; then _spike4dgs "$@"; else compdef _spike4dgs spike4dgs; fi',
    ]
    return "\n".join(lines) + "\n"


def _fish(first: Words, second: Mapping[str, Words]) -> str:
    def lines(condition: str, words: Words) -> list[str]:
        start = f"complete -c spike4dgs -n {condition} -f"
        return [f"{start} -a {word} -d {_quoted(text)}" for word, text in words.items()]

    all_lines = lines("__fish_use_subcommand", first)
    for command, words in second.items():
        all_lines += lines(f"'__fish_seen_subcommand_from {command}'", words)
    return "\n".join(all_lines) + "\n"


def _quoted(text: str) -> str:
    """Return text in single quotes, which all three shells read alike without an apostrophe or a backslash in it."""
    return "'" + text.replace("\\", "").replace("'", "’") + "'"
