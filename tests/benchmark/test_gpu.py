"""Choosing the device where PyTorch sees a GPU: faked in child processes, on machines with and without one."""

from __future__ import annotations

import json
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from spike4dgs.baselines.spike_to_image.table import IMAGES
from spike4dgs.benchmark import environment, gpu
from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.gpu import Missing, missing_rasterizer
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.images import on_device

# A PyTorch that claims a GPU, in an environment that has no gsplat.
_CLAIM = """
import importlib.util, sys, torch
torch.cuda.is_available, torch.cuda.device_count = lambda: True, lambda: 1
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, *a: None if name == "gsplat" else found(name, *a)
"""
_RUN = """
from types import SimpleNamespace
from spike4dgs.baselines.recipes import METHODS, PARTS
from spike4dgs.benchmark import plugins
from spike4dgs.benchmark.cli import main
from spike4dgs.benchmark.method import Recipe
from spike4dgs.method.fit import RecipeMethod
steps = {"trainer.coarse_steps": 4, "trainer.fine_steps": 4, "images.time_spacing_ticks": 20}
tiny = RecipeMethod(Recipe("tiny", "msdi", "rig", "static", "pixel", steps), PARTS)
methods = {"tiny": tiny, "nearest-view": METHODS["nearest-view"]}
entry = SimpleNamespace(name="theirs", value="theirs:METHODS", dist=None, load=lambda: methods)
plugins.entry_points = lambda group: [entry]
sys.exit(main(sys.argv[1:]))
"""


def claimed(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", _CLAIM + code, *arguments], capture_output=True, text=True, timeout=120
    )


def test_a_gpu_without_gsplat_means_the_cpu_and_one_line(small_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    methods = ("nearest-view", "tiny")
    arguments = ("--methods", *methods, "--metrics", "psnr", "--out", str(out))
    done = claimed(_RUN, "run-benchmark", str(small_scene), *arguments)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    line = done.stderr.strip()
    assert line.startswith("spike4dgs: computing on the CPU: PyTorch sees a CUDA device, but rendering on it needs")
    assert "pip install 'spike4dgs[cuda]'" in line and "--device cpu" in line
    for name in methods:
        cell = json.loads((out / f"results/{name}.json").read_text())["scenes"]["pattern-0"]
        assert cell["status"] == "ok" and cell["error"] is None
        prediction = json.loads((out / f"predictions/{name}/pattern-0/prediction.json").read_text())
        assert prediction["device"] == "cpu"


def test_asking_for_the_gpu_without_gsplat_is_one_error_before_any_fit(small_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ("run-benchmark", str(small_scene), "--methods", "tiny", "--device", "cuda", "--out", str(out))
    done = claimed(_RUN, *arguments)
    assert done.returncode == 2 and not out.exists()
    assert done.stderr == (
        "error: --device cuda: expected the package gsplat, found none; pip install 'spike4dgs[cuda]', which also "
        "needs a CUDA toolkit; or use --device cpu\n"
    )


def test_the_line_is_said_once_and_not_for_the_cpu() -> None:
    code = """
from spike4dgs.benchmark.environment import choose_device
for device in ("cpu", "auto", "auto"):
    print(choose_device(device), file=sys.stderr)
"""
    lines = claimed(code).stderr.splitlines()
    assert [line for line in lines if line != "cpu"] == [lines[1]] and lines[0] == "cpu" and len(lines) == 4


def test_networks_take_the_gpu_without_gsplat(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(environment, "missing_rasterizer", lambda: Missing("gsplat", "none", "install it"))
    assert choose_device("auto", rasterizes=False) == "cuda"
    assert choose_device("cuda:0", rasterizes=False) == "cuda:0"
    with pytest.raises(UserError, match="--device cuda:0: expected gsplat, found none; install it; or use"):
        choose_device("cuda:0")
    monkeypatch.setattr(environment, "missing_rasterizer", lambda: None)
    assert choose_device("auto") == "cuda" and choose_device("cuda") == "cuda"


@pytest.mark.parametrize("name", ["msdi", "spk2img"])
def test_image_makers_with_a_network_follow_the_fit(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    stream = SpikeStream(pack(np.ones((50, 8, 8), np.uint8)), 8, 8, 20_000.0)
    on_cpu = on_device(IMAGES[name], "cpu")
    assert on_cpu.name == name and on_cpu(stream, [25], 1.0).shape == (1, 8, 8)
    with pytest.raises(UserError, match="found 'cuda:7'"):
        on_device(IMAGES[name], "cuda:7")(stream, [25], 1.0)
    assert on_device(IMAGES["tfp"], "cuda:7") is IMAGES["tfp"]


def executable(path: Path, text: str = "") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\necho '{text}'\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


@pytest.fixture
def gsplat(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installed gsplat without a compiled extension, under a PyTorch for CUDA 12.8, and nothing on PATH."""
    package = tmp_path / "site/gsplat"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise AssertionError('imported')")
    monkeypatch.syspath_prepend(str(package.parent))
    monkeypatch.setattr(torch.version, "cuda", "12.8")
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    for name in ("CUDA_PATH", "CXX"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("CUDA_HOME", str(tmp_path / "cuda"))
    monkeypatch.setattr(gpu.sysconfig, "get_paths", lambda: {"include": str(tmp_path / "include")})
    return package


def test_a_compiled_gsplat_is_enough(gsplat: Path) -> None:
    (gsplat / "csrc.cpython-312-x86_64-linux-gnu.so").touch()
    assert missing_rasterizer() is None


def test_each_part_that_compiling_needs_is_named(gsplat: Path, tmp_path: Path) -> None:
    def found() -> tuple[str, str]:
        missing = missing_rasterizer()
        assert missing and missing.fix
        return missing.expected, missing.found

    assert found() == ("the CUDA toolkit 12.8, to compile gsplat", "no nvcc")
    nvcc = executable(tmp_path / "cuda/bin/nvcc", "Cuda compilation tools, release 11.8, V11.8.89")
    assert found() == ("the CUDA toolkit 12.8, to compile gsplat", f"{nvcc} of 11.8")
    executable(nvcc, "Cuda compilation tools, release 12.4, V12.4.131")
    assert found() == ("a C++ compiler, to compile gsplat", "no c++")
    executable(tmp_path / "bin/c++")
    assert found() == ("Python's headers, to compile gsplat", "no Python.h")
    (tmp_path / "include").mkdir()
    (tmp_path / "include/Python.h").touch()
    assert found() == ("ninja on PATH, to compile gsplat", "none")
    executable(tmp_path / "bin/ninja")
    assert missing_rasterizer() is None


def test_nvcc_is_found_on_the_path_too(gsplat: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CUDA_HOME")
    nvcc = executable(tmp_path / "bin/nvcc", "release 13.0")
    missing = missing_rasterizer()
    assert missing and missing.found == f"{nvcc} of 13.0"


@pytest.mark.usefixtures("gsplat")
def test_gsplat_needs_a_pytorch_with_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", None)
    missing = missing_rasterizer()
    assert missing and missing.expected == "a PyTorch with CUDA" and "pytorch.org" in missing.fix
