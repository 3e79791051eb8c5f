"""OpenMP's threads wait asleep, as libgomp itself reports, unless the user says otherwise."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

ROOMS = ("benchmark", "generators", "method", "baselines", "leaderboard", "cli")


@pytest.mark.parametrize(
    ("given", "waits"),
    [
        ({}, {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0"}),
        ({"OMP_WAIT_POLICY": "active"}, {"OMP_WAIT_POLICY": "ACTIVE"}),
        ({"GOMP_SPINCOUNT": "1234"}, {"GOMP_SPINCOUNT": "1234"}),
    ],
)
def test_openmp_waits_as_it_was_told(given: dict[str, str], waits: dict[str, str]) -> None:
    kept = {k: v for k, v in os.environ.items() if k not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    environment = kept | given | {"OMP_DISPLAY_ENV": "verbose"}
    code = "import spike4dgs.benchmark, torch"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    shown = dict(re.findall(r"(\w+) = '(\w+)'", done.stderr))
    if not shown:
        pytest.skip("torch brings another OpenMP than libgomp here")
    assert {name: shown[name] for name in waits} == waits


@pytest.mark.parametrize("room", ROOMS)
def test_every_room_says_so_before_torch_is_loaded(room: str) -> None:
    code = f"import os, sys, spike4dgs.{room}; print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)"
    kept = {k: v for k, v in os.environ.items() if k not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    done = subprocess.run([sys.executable, "-c", code], env=kept, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["PASSIVE", "False"]
