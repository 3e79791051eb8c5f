"""`doctor`, on this machine, on one without LLVM, and with parts that are missing or broken."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from spike4dgs.benchmark.environment import Missing
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.weights import WeightsError
from spike4dgs.cli import doctor
from spike4dgs.cli.doctor import BROKEN, MISSING, NOTE, OK, Finding, examine, report

LLVM = SimpleNamespace(name="llvm_ad_rgb", why_not_fast="", llvm=("/usr/lib/libLLVM.so.19.1", "/usr/lib/libLLVM-15.so"))


@pytest.fixture(autouse=True)
def machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with 16 lanes, 3 threads and LLVM, where no network is looked for."""
    monkeypatch.setattr("spike4dgs.method.splat.kernels.vector_ir.host_lanes", lambda: 16)
    monkeypatch.setattr("spike4dgs.method.splat.kernels.threads.get_threads", lambda: 3)
    monkeypatch.setattr("spike4dgs.generators.rendering.mitsuba_variant.diagnose", lambda: LLVM)
    monkeypatch.setattr(doctor, "NETWORKS", {})


def found(part: str) -> Finding:
    (finding,) = [f for f in examine() if f.part == part]
    return finding


def fail(error: Exception) -> Any:
    raise error


def test_on_a_machine_without_llvm_it_names_the_scalar_variant_and_what_mends_it(tmp_path: Path) -> None:
    env = os.environ | {"DRJIT_LIBLLVM_PATH": "/nonexistent", "XDG_CACHE_HOME": str(tmp_path)}
    env |= {"COLUMNS": "80", "SPIKE4DGS_DUST3R": ""}
    env.pop("SPIKE4DGS_MITSUBA_VARIANT", None)
    done = subprocess.run([sys.executable, "-m", "spike4dgs.cli", "doctor"], capture_output=True, text=True, env=env)
    assert done.returncode == 0 and done.stderr == ""
    lines = done.stdout.splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith("mitsuba "))
    assert "missing" in lines[at] and "scalar_rgb" in lines[at]
    fix = next(line for line in lines[at:] if line.startswith("    > "))
    assert fix == "    > unset DRJIT_LIBLLVM_PATH, or name a libLLVM 19 in it"
    assert any(line.startswith("DUSt3R ") and "missing" in line for line in lines)
    assert lines[-1].startswith("The benchmark runs here. ")
    assert all(len(line) <= 80 for line in lines if not line.startswith("    > "))


def test_what_is_found_is_said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(doctor, "NETWORKS", {"MSDI": lambda: Path("a/msdi.safetensors")})
    names = {f.part: f for f in examine()}
    assert names["CPU kernels"].found.endswith("16 floats a vector, threads: 3")
    assert names["mitsuba"].found.endswith("llvm_ad_rgb; LLVM 15, 19")
    assert names["MSDI"] == Finding("MSDI", OK, "msdi.safetensors")
    assert names["torch"].found.startswith(torch.__version__)
    assert f"{shutil.disk_usage('.').total / 2**30:.1f} GiB" in names["disk"].found
    assert names["packages"].state == OK
    assert report(list(names.values())) == 0
    shown = capsys.readouterr().out.splitlines()
    assert all(any(line.startswith(f"{part} ") for line in shown) for part in names)


def test_the_weights_that_users_bring_may_be_missing_and_a_damaged_file_is_broken(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    error = problem("here", "weights", "SPIKE4DGS_X not set", "get the file; then set SPIKE4DGS_X")
    monkeypatch.setattr(doctor, "NETWORKS", {"X": partial(fail, WeightsError(str(error), ""))})
    absent = found("X")
    assert absent == Finding("X", MISSING, "no weights", "then set SPIKE4DGS_X")
    error = problem("x.pt", "weights", "damaged data", "mend it")
    monkeypatch.setattr(doctor, "NETWORKS", {"X": partial(fail, error)})
    damaged = found("X")
    assert damaged.state == BROKEN and "x.pt: expected weights, found damaged data" in damaged.found
    assert report([absent, damaged]) == 1
    assert "Broken: X. Optional parts missing: 1." in capsys.readouterr().out


def test_a_failing_check_stops_no_other(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    lanes = partial(fail, ImportError("no module numba\nmore"))
    monkeypatch.setattr("spike4dgs.method.splat.kernels.vector_ir.host_lanes", lanes)
    findings = examine()
    broken = [f for f in findings if f.state == BROKEN]
    assert [(f.part, f.found) for f in broken] == [("CPU kernels", "ImportError: no module numba")]
    assert {"mitsuba", "torch", "GPU"} <= {f.part for f in findings}
    assert report(findings) == 1 and "Broken: CPU kernels." in capsys.readouterr().out


def test_required_packages_that_are_not_installed_are_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = ["torch>=2.6", "no-such-package>=1", 'viser>=1.0; extra == "viewer"']
    monkeypatch.setattr(doctor, "requires", lambda name: listed)
    packages = found("packages")
    assert packages == Finding("packages", BROKEN, "not installed: no-such-package", "pip install no-such-package")


def test_optional_packages_and_libraries_come_with_their_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "OPTIONAL", (("no-such-package", "viewer", "`view`"),))
    monkeypatch.setattr(doctor, "LIBRARIES", (("no-such-library", "libnothing0", "`record`"),))
    assert found("no-such-package").fix == "pip install 'spike4dgs[viewer]'"
    assert found("libnothing0").fix == "apt-get install libnothing0"


def test_each_extra_of_a_command_is_looked_for_and_each_weight_file_has_its_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    own = {"cuda", "cuda12", "test", "docs"}  # a row on CUDA, and what developers need
    wanted = {
        (re.split(r"[^\w-]", line)[0], extra)
        for extra, lines in project["optional-dependencies"].items()
        for line in lines
        if extra not in own
    }
    assert {(package, extra) for package, extra, _ in doctor.OPTIONAL} == wanted
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.delenv("SPIKE4DGS_WEIGHTS", raising=False)
    assert found("LPIPS alex").fix == "spike4dgs download weights lpips"
    assert found("SCFlow") == Finding("SCFlow", MISSING, "no scflow_dt10.pth", "spike4dgs download weights scflow")
    assert found("MetaIQA").fix.startswith("save the state dict of the network of https://github.com/zhuhancheng/")
    assert found("MetaIQA").fix.endswith(f" as {tmp_path}/hub/checkpoints/metaiqa_resnet18.pth")
    monkeypatch.delenv("SPIKE4DGS_DUST3R", raising=False)
    monkeypatch.setattr(doctor, "NETWORKS", {"DUSt3R": partial(doctor._weights, "DUSt3R")})
    assert found("DUSt3R").fix.startswith("run `spike4dgs download weights dust3r`, or")


def test_a_gpu_without_kernels_is_optional_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(doctor.ctypes.util, "find_library", lambda name: None)
    assert found("GPU").state == found("CUDA kernels").state == NOTE
    monkeypatch.setattr(doctor.ctypes.util, "find_library", lambda name: f"lib{name}.so.1")
    assert found("GPU").state == MISSING and "pytorch.org" in found("GPU").fix
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda i: f"Toy {i}")
    monkeypatch.setattr(doctor, "missing_rasterizer", lambda: Missing("numba", "none", "install it"))
    assert found("GPU").found.startswith("Toy 0")
    wanted = Finding("CUDA kernels", MISSING, "renders on the CPU: needs numba, found none", "install it")
    assert found("CUDA kernels") == wanted
    monkeypatch.setattr(doctor, "missing_rasterizer", lambda: None)
    assert found("CUDA kernels").state == OK
