"""OpenMP's threads wait asleep, as libgomp itself reports, unless the user says otherwise."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

ROOMS = ("benchmark", "generators", "method", "baselines", "leaderboard", "cli")


def run(code: str, **given: str) -> subprocess.CompletedProcess[str]:
    """Run code in a process whose environment says nothing but `given` of waiting."""
    kept = {k: v for k, v in os.environ.items() if k not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    return subprocess.run([sys.executable, "-c", code], env=kept | given, capture_output=True, text=True, check=True)


def test_libgomp_waits_as_it_was_told() -> None:
    shown = dict(re.findall(r"(\w+) = '(\w+)'", run("import spike4dgs.cli, torch", OMP_DISPLAY_ENV="verbose").stderr))
    if not shown:
        pytest.skip("torch brings another OpenMP than libgomp here")
    assert (shown["OMP_WAIT_POLICY"], shown["GOMP_SPINCOUNT"]) == ("PASSIVE", "0")


@pytest.mark.parametrize("given", [{"OMP_WAIT_POLICY": "active"}, {"GOMP_SPINCOUNT": "1234"}])
def test_what_the_user_says_stays(given: dict[str, str]) -> None:
    names = "OMP_WAIT_POLICY", "GOMP_SPINCOUNT"
    shown = run(f"import os, spike4dgs.benchmark; print([os.environ.get(name) for name in {names}])", **given)
    assert shown.stdout.strip() == str([given.get(name) for name in names])


@pytest.mark.parametrize("room", ROOMS)
def test_every_room_says_so_before_torch_is_loaded(room: str) -> None:
    code = f"import os, sys, spike4dgs.{room}; print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)"
    assert run(code).stdout.split() == ["PASSIVE", "False"]
