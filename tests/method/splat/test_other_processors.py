"""The kernels become machine code of ARM, for Linux and for macOS: no intrinsic of x86, and NEON's vectors.

A child process lets numba compile for a generic processor with vectors of 8 floats, as on ARM, and hands each module to
LLVM's compiler for ARM too, before numba's own turns it into code of this machine. ARM's is not
optimised, which would take long: the kernels themselves say where their vectors are. The kernels that project are
plain numba around two intrinsics of ours, and take it twice as long as all others: the intrinsics are compiled alone.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

CHILD = r"""
import functools, gc, json, re
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

import numba.extending
plain, ours, compiled = numba.extending.intrinsic, set(), set()

def watched(*given, **options):
    if not given:
        return lambda function: watched(function, **options)
    name = f"{given[0].__module__}.{given[0].__qualname__}, {len(ours)}"
    ours.add(name)

    @functools.wraps(given[0])
    def seen(*args, **others):
        compiled.add(name)
        return given[0](*args, **others)

    return plain(**options)(seen) if options else plain(seen)

numba.extending.intrinsic = watched  # functions that are written in LLVM's language

from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.splat import PixelFilter, cpu
from spike4dgs.method.splat.kernels.project import log2
from spike4dgs.method.splat.kernels.vector_ir import float_bits, host_lanes
from spike4dgs.method.splat.ssim import l1_and_ssim

assert host_lanes() == 8
none = [((1, 0, 8), "f8"), ((1, 0), "u4"), ((1, 0), "f4"), ((1, 0, 4), "i4"), ((1, 1), "i4"), (0, "u8"), (2, "i8")]
nothing = cpu.Projection(None, *(np.zeros(shape, kind) for shape, kind in none))
size = cpu.Settings(8, 8, PixelFilter(), False)
frames = cpu.composite(nothing, np.zeros((1, 1, 0), np.float32), 2, cpu.no_layer(), size)
cpu.record_sums(frames, size, frames.image, frames.alpha, 2)
numba.njit(lambda x: log2(np.float64(x)) + float_bits(x))(np.float32(3))  # all that those that project add
image = torch.rand(1, 40, 64, requires_grad=True)
l1_and_ssim(image, torch.rand(1, 40, 64), 0.2).backward()
spikes = np.random.default_rng(0).random((40, 16, 24)) < 0.3
stream = SpikeStream(pack(spikes), 24, 16, 20_000.0)
assert (stream.window(0, 40) == spikes).all()
missing = [name for name in ours - compiled if name.startswith("spike4dgs.method.splat.")]
assert len(ours) > len(missing) == 0, missing
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
def test_every_kernel_of_ours_becomes_code_of_arm(modules: list[Module], triple: str) -> None:
    found = [module for module in modules if module[1] == triple]
    for kernel in ("raster_forward", "raster_backward", "_loss_kernel", "_unpack", "lambda"):
        assert any(kernel in name for name, *_ in found), kernel
    assert not [(name, x86) for name, _, x86, lines, _ in found if x86 or not lines]
    assert sum(vectors for *_, vectors in found) > 100, "NEON multiplies four floats at once"
