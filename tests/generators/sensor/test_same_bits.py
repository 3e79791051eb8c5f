"""Spikes from given radiance are the same bits on every processor: without FMA, AVX2 or AVX-512 too."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

_SCRIPT = """
import hashlib
import numpy as np
from spike4dgs.generators.sensor.kernels import integrate
from spike4dgs.generators.sensor.model import Sensor, random_charge, simulate

rng = np.random.default_rng(5)
height, width = 20, 70
base = rng.random((height, width), np.float32)
keys = [np.clip(base + 0.1 * k * (rng.random((height, width), np.float32) - 0.3), 0, 1.6) for k in range(9)]
for key in keys:
    key[:5] = base[:5]  # light that does not change
gain = 0.9 + 0.2 * rng.random((height, width), np.float32)
dark = 0.005 * rng.random((height, width), np.float32)
charge = random_charge(height, width, [1, 2])
for sensor in (Sensor(), Sensor(gain=gain, dark=dark, photons=50000.0, noise_seed=(3,))):
    for ticks, means in (([0, 10, 20, 37, 40, 60, 80, 81, 200], False), (range(9), True)):
        spikes = np.concatenate([*simulate(keys, list(ticks), 9 if means else 200, sensor, charge, means=means)])
        print(hashlib.sha256(spikes).hexdigest())
code = "".join(integrate.inspect_asm().values())
print("wide" if "zmm" in code or "ymm" in code else "narrow", "fused" if "vfmadd" in code else "separate")
"""


def simulated(cache: Path, **environment: str) -> list[str]:
    """The hashes of the spikes in a process of its own, and the kind of instructions that made them."""
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT],
        env={**os.environ, "NUMBA_CACHE_DIR": str(cache), **environment},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_an_old_processor_gives_the_same_spikes(tmp_path: Path) -> None:
    umath = np._core._multiarray_umath  # type: ignore[attr-defined]
    there = [name for name in umath.__cpu_dispatch__ if umath.__cpu_features__[name]]
    here = simulated(tmp_path)
    old = simulated(
        tmp_path,
        NUMBA_CPU_NAME="generic",
        NUMBA_CPU_FEATURES="",
        NPY_DISABLE_CPU_FEATURES=" ".join(there),
        OPENBLAS_CORETYPE="Nehalem",
    )
    assert len(here) == 5 and here[:4] == old[:4] and len(set(here[:4])) == 4
    assert "separate" in here[4] and old[4] == "narrow separate"
    if not here[4].startswith("wide"):
        pytest.skip("this processor has no wide registers: both runs used the same instructions")
