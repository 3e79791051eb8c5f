"""OpenBLAS computes with the same kernels on every processor that has AVX2, so that poses have the same bits."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from spike4dgs.benchmark import _has_avx2

ROOMS = ("benchmark", "generators", "method", "baselines", "leaderboard", "cli")
POSES = """
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import WORLDS
import numpy as np
poses = [c.c2w for world in ("car", "bird") for c in cameras(WORLDS[world].build(0, 0, 0.02), 200, 125)]
print(np.array(poses).tobytes().hex())
"""
needs_avx2 = pytest.mark.skipif(not _has_avx2(), reason="this processor has no AVX2")


def run(code: str, **given: str) -> str:
    """Run code in a process whose environment says nothing but `given` of OpenBLAS; return what it prints."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("OPENBLAS")}
    done = subprocess.run([sys.executable, "-c", code], env=kept | given, capture_output=True, text=True, check=True)
    return done.stdout.strip()


@needs_avx2
def test_poses_have_the_bits_of_the_kernels_for_avx2() -> None:
    assert run(POSES) == run(POSES, OPENBLAS_CORETYPE="Haswell")


@needs_avx2
@pytest.mark.parametrize("room", ROOMS)
def test_every_room_says_so_before_numpy_is_loaded(room: str) -> None:
    code = f"import os, sys, spike4dgs.{room}; print(os.environ['OPENBLAS_CORETYPE'])"
    assert run(code) == "Haswell"


def test_numpy_is_loaded_after_the_room_that_says_so() -> None:
    assert run("import sys, spike4dgs.benchmark; print('numpy' in sys.modules)") == "False"


def test_what_the_user_says_stays() -> None:
    code = "import os, spike4dgs.benchmark; print(os.environ['OPENBLAS_CORETYPE'])"
    assert run(code, OPENBLAS_CORETYPE="Zen") == "Zen"
