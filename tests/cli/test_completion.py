"""Completion scripts, as the shells themselves read them."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import get_args

import pytest

from spike4dgs.cli import COMMANDS, main
from spike4dgs.cli.completion import Shell, script


def completed(folder: Path, *words: str) -> list[str]:
    """Return what bash offers for the last of the words after `spike4dgs`."""
    (folder / "script").write_text(script("bash"))
    line = " ".join(f"'{w}'" for w in ("spike4dgs", *words))
    code = (
        f'source "{folder}/script"; COMP_WORDS=({line}); COMP_CWORD={len(words)}; _spike4dgs; echo "${{COMPREPLY[@]}}"'
    )
    done = subprocess.run(["bash", "--norc", "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_bash_completes_commands_and_leaves_the_rest_to_files(tmp_path: Path) -> None:
    words = dict.fromkeys(name.partition(" ")[0] for name in COMMANDS)
    assert completed(tmp_path, "") == [*words, "--help", "--version"]
    assert completed(tmp_path, "release", "") == ["pack", "check"]
    assert completed(tmp_path, "download", "") == ["weights"]
    assert completed(tmp_path, "run-") == ["run-benchmark"]
    assert completed(tmp_path, "speed", "") == ["render", "record", "images"]
    assert completed(tmp_path, "completion", "z") == ["zsh"]
    assert completed(tmp_path, "verify", "") == [] == completed(tmp_path, "speed", "render", "")
    assert "complete -o bashdefault -o default" in script("bash"), "no word offered: file names are"


@pytest.mark.parametrize("shell", get_args(Shell))
def test_the_shell_can_read_its_script(shell: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    text = capsys.readouterr().out
    assert all(word in text for name in COMMANDS for word in name.split())
    assert text.count("'") % 2 == 0
    if not (program := shutil.which(shell)):
        pytest.skip(f"no {shell} here")
    (tmp_path / "script").write_text(text)
    done = subprocess.run(
        [program, "-n", str(tmp_path / "script")],
        capture_output=True,
        text=True,
        env=os.environ | {"HOME": str(tmp_path)},
    )
    assert done.returncode == 0 and not done.stderr


def test_another_shell_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "tcsh"]) == 2
    assert "tcsh" in capsys.readouterr().err
