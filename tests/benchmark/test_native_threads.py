"""What the rooms tell OpenBLAS and OpenMP before NumPy and torch load them, unless the user says otherwise.

OpenBLAS computes with the same kernels on every processor that has AVX2, so that poses have the same bits. OpenMP's
threads wait asleep.
"""

import os
import re
import subprocess
import sys

import pytest

from spike4dgs.benchmark import _has_avx2

NAMES = ("OPENBLAS_CORETYPE", "OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
ROOMS = ("benchmark", "generators", "method", "baselines", "leaderboard", "cli")
SHOW = f"print([os.environ.get(name) for name in {NAMES}], 'torch' in sys.modules)"
POSES = """
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import WORLDS
import numpy as np
poses = [c.c2w for world in ("car", "bird") for c in cameras(WORLDS[world].build(0, 0, 0.02), 200, 125)]
print(np.array(poses).tobytes().hex())
"""


def run(code: str, **given: str) -> subprocess.CompletedProcess[str]:
    """Run code in a process whose environment says nothing but `given` of kernels and of waiting."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("OPENBLAS") and k not in NAMES}
    return subprocess.run([sys.executable, "-c", code], env=kept | given, capture_output=True, text=True, check=True)


@pytest.mark.skipif(not _has_avx2(), reason="this processor has no AVX2")
def test_poses_have_the_bits_of_the_kernels_for_avx2() -> None:
    assert run(POSES).stdout == run(POSES, OPENBLAS_CORETYPE="Haswell").stdout


@pytest.mark.parametrize("room", ROOMS)
def test_every_room_says_so_before_numpy_and_torch_are_loaded(room: str) -> None:
    kernels = "Haswell" if _has_avx2() else None
    assert run(f"import os, sys, spike4dgs.{room}; {SHOW}").stdout.strip() == f"{[kernels, 'PASSIVE', None]} False"


def test_libgomp_waits_as_it_was_told() -> None:
    shown = dict(re.findall(r"(\w+) = '(\w+)'", run("import spike4dgs.cli, torch", OMP_DISPLAY_ENV="verbose").stderr))
    if not shown:
        pytest.skip("torch brings another OpenMP than libgomp here")
    assert (shown["OMP_WAIT_POLICY"], shown["GOMP_SPINCOUNT"]) == ("PASSIVE", "0")


@pytest.mark.parametrize("given", [{"OMP_WAIT_POLICY": "active", "OPENBLAS_CORETYPE": "Zen"}, {"GOMP_SPINCOUNT": "12"}])
def test_what_the_user_says_stays(given: dict[str, str]) -> None:
    shown = run(f"import os, sys, spike4dgs.benchmark; {SHOW}", **given).stdout.strip()
    kernels = given.get("OPENBLAS_CORETYPE", "Haswell" if _has_avx2() else None)
    assert shown == f"{[kernels, *(given.get(name) for name in NAMES[1:])]} False"
