"""`make clients`: how a client's values are judged. Its clients need environments, which that job makes."""

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).resolve().parent / "clients"


@pytest.fixture(scope="module")
def job() -> Any:
    sys.path.insert(0, str(FOLDER))
    try:
        import run
    finally:
        sys.path.remove(str(FOLDER))
    return run


@pytest.mark.parametrize(
    ("theirs", "state"),
    [
        ([1.0, 2.0], "equal"),
        ([1.0, 2.1], "equal"),
        ([1.0, 2.2], "differs"),
        ([1.0, math.nan], "differs"),
        ([math.inf, 2.0], "differs"),
        ([1.0], "failed"),
        ([], "failed"),
        (None, "failed"),
    ],
)
def test_a_value_equals_ours_where_every_number_does(job: Any, theirs: list[float] | None, state: str) -> None:
    client = replace(job.CLIENTS[0], name="it", values={"value": 0.125})
    (row,) = job.compare(client, "1.0", {} if theirs is None else {"value": theirs}, {"value": [1.0, 2.0]})
    assert row.state == state and (row.client, row.version) == ("it", "1.0")
    cells = row.cells()
    assert len(cells) == len(job.COLUMNS) and ("differs" in " ".join(cells)) == (state == "differs")
    if state == "failed":
        assert f"failed: {len(theirs or [])} numbers for value, expected 2" in cells


def test_every_client_is_pinned_and_has_a_script(job: Any) -> None:
    names = [client.name for client in job.CLIENTS]
    assert len(set(names)) == len(names)
    for client in job.CLIENTS:
        assert (FOLDER / client.script).is_file() and client.values
        assert all("==" in pin for pin in (*client.packages, *client.bare))
        assert all(pin.count("@") == 2 for pin in client.npm), "scope and version"
        assert bool(client.npm) != bool(client.packages)


def test_what_cannot_be_installed_is_skipped_and_what_fails_is_not(job: Any, tmp_path: Path) -> None:
    nowhere = replace(job.CLIENTS[0], name="nowhere", packages=("no-such==1",), bare=(), npm=(), prepare=None)

    def refuse(command: list[str]) -> None:
        raise subprocess.CalledProcessError(1, command, stderr="WARNING: odd\nERROR: No matching distribution\n")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(job, "run", refuse)
        (row,) = job.check(nowhere, tmp_path, tmp_path / "homes")
    assert (row.state, row.reason) == ("skipped", "ERROR: No matching distribution")
    with pytest.MonkeyPatch.context() as patch:  # this interpreter, in which the client is not installed
        patch.setattr(job, "install", lambda client, homes, env: (Path(sys.executable), {}))
        (row,) = job.check(replace(nowhere, script="read_gsply.py"), tmp_path, tmp_path / "homes")
    assert row.state == "failed" and row.reason.startswith("ModuleNotFoundError: No module named")
