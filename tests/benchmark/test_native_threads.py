"""What the rooms tell OpenBLAS and OpenMP before NumPy and torch load them, unless the user says otherwise.

OpenBLAS computes with the same kernels on every processor that has AVX2, so that poses have the same bits. OpenMP's
threads wait asleep.
"""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from spike4dgs.benchmark import _has_avx2
from spike4dgs.benchmark import environment as environments
from spike4dgs.benchmark.machine import quota
from spike4dgs.benchmark.machine.quota import limit_openmp, quota_cores

NAMES = ("OPENBLAS_CORETYPE", "OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
ROOMS = ("benchmark", "generators", "method", "baselines", "leaderboard", "cli")
SHOW = f"print([os.environ.get(name) for name in {NAMES}], 'torch' in sys.modules)"
POSES = """
from spike4dgs.benchmark.scene.cameras import look_at
import numpy as np
SIZE, rng = {'focal': 48.0, 'width': 40, 'height': 24}, np.random.default_rng(0)
poses = [look_at("a", p, np.zeros(3), np.eye(3)[2], **SIZE).c2w for p in rng.normal(size=(50, 3))]
a = rng.normal(size=(70, 70))
print(np.concatenate([np.ravel(x) for x in (*poses, a @ a, np.linalg.inv(a))]).tobytes().hex())
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
    """The one that torch brings, whose own import takes long."""
    root = Path(str(importlib.util.find_spec("torch").origin)).parent  # type: ignore[union-attr]
    found = sorted([*root.rglob("libgomp*.so*"), *root.parent.glob("torch.libs/libgomp*.so*")])
    if not found:
        pytest.skip("torch brings another OpenMP than libgomp here")
    code = f"import spike4dgs.cli, ctypes; ctypes.CDLL({str(found[0])!r})"
    shown = dict(re.findall(r"(\w+) = '(\w+)'", run(code, OMP_DISPLAY_ENV="verbose").stderr))
    assert (shown["OMP_WAIT_POLICY"], shown["GOMP_SPINCOUNT"]) == ("PASSIVE", "0")


@pytest.mark.parametrize("given", [{"OMP_WAIT_POLICY": "active", "OPENBLAS_CORETYPE": "Zen"}, {"GOMP_SPINCOUNT": "12"}])
def test_what_the_user_says_stays(given: dict[str, str]) -> None:
    shown = run(f"import os, sys, spike4dgs.benchmark; {SHOW}", **given).stdout.strip()
    kernels = given.get("OPENBLAS_CORETYPE", "Haswell" if _has_avx2() else None)
    assert shown == f"{[kernels, *(given.get(name) for name in NAMES[1:])]} False"


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({"cpu.max": "200000 100000\n"}, 2),
        ({"cpu.max": "150000 100000\n"}, 2),
        ({"cpu.max": "max 100000\n"}, None),
        ({"cpu/cpu.cfs_quota_us": "300000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 3),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, None),
        ({}, None),
    ],
)
def test_the_cores_of_a_container_are_known(files: dict[str, str], cores: int | None, tmp_path: Path) -> None:
    (tmp_path / "cpu").mkdir()
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    assert quota_cores(str(tmp_path)) == cores


@pytest.mark.parametrize(("limit", "cores"), [(None, 8), (3, 3), (16, 8)])
def test_a_container_with_less_time_than_cores_has_fewer_threads(
    limit: int | None, cores: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    for module in (quota, environments):
        monkeypatch.setattr(module, "quota_cores", lambda: limit)
    given, unset = {"OMP_NUM_THREADS": "5"}, dict[str, str]()
    for environment in (given, unset):
        limit_openmp(environment)
    assert environments.available_cores() == cores
    assert given == {"OMP_NUM_THREADS": "5"} and unset == ({"OMP_NUM_THREADS": "3"} if limit == 3 else {})
