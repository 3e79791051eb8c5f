"""Completion scripts, as the shells themselves read them."""

import os
import shutil
import subprocess
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import get_args

import pytest

from spike4dgs.cli import COMMANDS, main
from spike4dgs.cli.completion import Shell


@pytest.fixture(scope="module")
def scripts() -> dict[str, str]:
    """Return the script of each shell."""
    found = {}
    for shell in get_args(Shell):
        with redirect_stdout(StringIO()) as written:
            assert main(["completion", shell]) == 0
        found[shell] = written.getvalue()
    return found


def completed(script: Path, *words: str) -> list[str]:
    """Return what bash offers for the last of the words after `spike4dgs`."""
    line = " ".join(f"'{w}'" for w in ("spike4dgs", *words))
    code = f'source "{script}"; COMP_WORDS=({line}); COMP_CWORD={len(words)}; _tyro_spike4dgs; echo "${{COMPREPLY[@]}}"'
    done = subprocess.run(["bash", "--norc", "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_bash_completes_commands_verbs_and_options(scripts: dict[str, str], tmp_path: Path) -> None:
    (script := tmp_path / "script").write_text(scripts["bash"])
    assert set(completed(script, "")) == {"-h", "--help", *(name.partition(" ")[0] for name in COMMANDS)}
    assert {"pack", "check"} < set(completed(script, "release", ""))
    assert completed(script, "run-") == ["run-benchmark"]
    assert completed(script, "fit", "--bud") == ["--budget"]
    assert completed(script, "verify", "da") == []
    assert scripts["bash"].endswith("complete -o bashdefault -o default -F _tyro_spike4dgs spike4dgs\n"), "file names"


@pytest.mark.parametrize("shell", get_args(Shell))
def test_the_shell_can_read_its_script(shell: str, scripts: dict[str, str], tmp_path: Path) -> None:
    if not (program := shutil.which(shell)):
        pytest.skip(f"no {shell} here")
    (tmp_path / "script").write_text(scripts[shell])
    command, home = [program, "-n", str(tmp_path / "script")], {"HOME": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | home)
    assert done.returncode == 0 and not done.stderr
