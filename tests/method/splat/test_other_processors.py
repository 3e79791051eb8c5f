"""The kernels become machine code of ARM, for Linux and for macOS: no intrinsic of x86, and NEON's vectors.

A child process lets numba compile for a generic processor with vectors of 8 floats, as on ARM, and hands each module to
LLVM's compiler for ARM too, before numba's own turns it into code of this machine. ARM's is not
optimised, which would take long: the kernels themselves say where their vectors are.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

CHILD = r"""
import gc, json, re
gc.disable()  # the compiler makes many objects, and none of them is garbage for long
import llvmlite.binding as llvm
import numpy as np
import torch
from numba.core.codegen import CPUCodeLibrary

llvm.initialize_all_targets()
llvm.initialize_all_asmprinters()
TRIPLES = ("aarch64-unknown-linux-gnu", "arm64-apple-macosx")
machines = {t: llvm.Target.from_triple(t).create_target_machine(opt=0) for t in TRIPLES}
made, add = [], CPUCodeLibrary.add_llvm_module

def add_and_compile_for_arm(library, module):
    x86 = re.findall(r"llvm\.x86\.[\w.]+", str(module))
    for triple, machine in machines.items():
        ours = module.clone()
        ours.triple, ours.data_layout = triple, str(machine.target_data)
        ours.verify()
        assembly = machine.emit_assembly(ours)
        vectors = len(re.findall(r"fm(?:la|ul|ls)(?:\.4s|\s+v\d+\.4s)", assembly))
        made.append((library.name, triple, x86, assembly.count("\n"), vectors))
    add(library, module)

CPUCodeLibrary.add_llvm_module = add_and_compile_for_arm

from splat_parity import differentiate
from splat_scenes import random_splats, views
v = views()
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.splat.kernels.vector_ir import host_lanes
from spike4dgs.method.splat.ssim import l1_and_ssim

assert host_lanes() == 8
differentiate(random_splats(50, seed=1), v, "cpu", torch.ones(2, v.height, v.width), True)
image = torch.rand(1, 40, 64, requires_grad=True)
l1_and_ssim(image, torch.rand(1, 40, 64), 0.2).backward()
spikes = np.random.default_rng(0).random((40, 16, 24)) < 0.3
stream = SpikeStream(pack(spikes), 24, 16, 20_000.0)
assert (stream.window(0, 40) == spikes).all()
print(json.dumps(made))
"""


Module = tuple[str, str, list[str], int, int]  # name, triple, intrinsics of x86, lines, products of four floats


@pytest.fixture(scope="module")
def modules(tmp_path_factory: pytest.TempPathFactory) -> list[Module]:
    support = Path(__file__).parents[2] / "support"
    folders = {"NUMBA_CACHE_DIR": str(tmp_path_factory.mktemp("numba")), "PYTHONPATH": str(support)}
    environment = os.environ | folders | {"NUMBA_CPU_NAME": "generic", "NUMBA_OPT": "0", "PYTHONWARNINGS": "ignore"}
    command = [sys.executable, "-c", CHILD]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return [tuple(module) for module in json.loads(done.stdout.splitlines()[-1])]  # type: ignore[misc]


@pytest.mark.slow
@pytest.mark.parametrize("triple", ["aarch64-unknown-linux-gnu", "arm64-apple-macosx"])
def test_every_kernel_becomes_code_of_arm(modules: list[Module], triple: str) -> None:
    found = [module for module in modules if module[1] == triple]
    project_and_raster = [f"{work}_{way}" for work in ("project", "raster") for way in ("forward", "backward")]
    for kernel in (*project_and_raster, "_loss_kernel", "_unpack"):
        assert any(kernel in name for name, *_ in found), kernel
    assert not [(name, x86) for name, _, x86, lines, _ in found if x86 or not lines]
    assert sum(vectors for *_, vectors in found) > 100, "NEON multiplies four floats at once"
