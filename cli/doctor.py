"""`doctor`: what this machine has for the benchmark, what it lacks, and the line that fixes each."""

from __future__ import annotations

import ctypes.util
import os
import re
import shutil
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib.metadata import requires, version
from pathlib import Path

import psutil
from rich.console import Console
from rich.text import Text

from spike4dgs.benchmark.environment import PYTORCH, cpu_name, installed_version, missing_rasterizer
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.weights import ALEXNET, METAIQA, SQUEEZENET, VGG16, WeightFile, WeightsError, find_weights

OK, MISSING, BROKEN, NOTE = "ok", "missing", "broken", "-"
_STYLES = {OK: "green", MISSING: "yellow", BROKEN: "bold red", NOTE: "dim"}
_UNATTENDED_WIDTH = 120  # where the output is no terminal

# Package, the extra that installs it, and what needs it.
OPTIONAL = (
    ("viser", "viewer", "`view`"),
    ("distributed", "cluster", "`--scheduler` on many machines"),
    ("dask-jobqueue", "cluster", "batch jobs of SLURM, as in docs/cluster.md"),
    ("pandas", "pandas", "results as data frames"),
    ("fsspec", "download", "`download`"),
    ("aiohttp", "download", "`download` over http"),
    ("huggingface_hub", "download", "Hugging Face, in `download` and `release publish`"),
    ("mlcroissant", "download", "the validation of Croissant in `release check`"),
    ("optuna", "tuning", "`report tuning`"),
)
# Library, its Debian package, and what needs it.
LIBRARIES = (("usb-1.0", "libusb-1.0-0", "`record` from cameras"), ("umockdev", "umockdev", "the tests of `record`"))

METRIC_WEIGHTS = (("LPIPS alex", ALEXNET), ("LPIPS vgg", VGG16), ("LPIPS squeeze", SQUEEZENET), ("MetaIQA", METAIQA))


@dataclass(frozen=True)
class Finding:
    """A part of the machine, its state, what was found, and the line that fixes it."""

    part: str
    state: str
    found: str
    fix: str = ""


Check = Callable[[], Iterator[Finding]]


def doctor(*, gpu_receipt: Path | None = None) -> int:
    """Report what this machine has, what it lacks, and how to fix it. Nothing is installed or changed.

    The exit code is 1 if something that every run needs is broken, and 0 otherwise.

    Args:
        gpu_receipt: Instead, run the GPU tests and a timing, which takes some minutes, and write both to this JSON
            file, for you to send. It names the card and the library versions, but no user, host or folder. This needs
            a checkout with the extra `test`. The exit code is 1 if a test failed.
    """
    if gpu_receipt is not None:
        from spike4dgs.studies.gpu_receipt.command import gpu_receipt as make

        return make(gpu_receipt)
    return report(examine())


def examine() -> list[Finding]:
    """Return the findings of all checks."""
    checks: dict[str, Check] = {
        "processor": _processor,
        "CPU kernels": _kernels,
        "packages": _packages,
        "torch": _torch,
        "mitsuba": _mitsuba,
        "GPU": _gpu,
        "optional": _optional,
        "metrics": _metrics,
        "published images": _published,
        **{name: partial(_network, name, find) for name, find in NETWORKS.items()},
    }
    return [finding for part, check in checks.items() for finding in _try(part, check)]


def report(findings: list[Finding]) -> int:
    """Print the findings and a verdict; return the exit code."""
    console = Console(highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console = Console(highlight=False, width=_UNATTENDED_WIDTH)
    indent = 2 + max(len(f.part) for f in findings)
    for finding in findings:
        _print(console, finding, indent)
    broken = [f.part for f in findings if f.state == BROKEN]
    missing = sum(f.state == MISSING for f in findings)
    verdict = f"Broken: {', '.join(broken)}." if broken else "The benchmark runs here."
    console.print(f"{verdict} Optional parts missing: {missing}.", markup=False)
    return 1 if broken else 0


def _try(part: str, check: Check) -> list[Finding]:
    """Return what a check finds; where it fails, that is a finding, and the other checks still run."""
    found: list[Finding] = []
    try:
        found.extend(check())
    except UserError as e:
        found.append(Finding(part, BROKEN, str(e)))
    except Exception as e:  # a package that is damaged can raise anything
        first = str(e).partition("\n")[0]
        found.append(Finding(part, BROKEN, f"{type(e).__name__}: {first}", "pip install --force-reinstall spike4dgs"))
    return found


def _processor() -> Iterator[Finding]:
    yield Finding("processor", OK, cpu_name())
    memory = psutil.virtual_memory()
    yield Finding("memory", OK, f"{memory.available / 2**30:.1f} of {memory.total / 2**30:.1f} GiB free")
    disk = shutil.disk_usage(Path.cwd())
    yield Finding("disk", OK, f"{disk.free / 2**30:.1f} of {disk.total / 2**30:.1f} GiB free in {Path.cwd()}")


def _kernels() -> Iterator[Finding]:
    import llvmlite.binding

    from spike4dgs.method.splat.kernels.threads import get_threads
    from spike4dgs.method.splat.kernels.vector_ir import host_lanes

    features = llvmlite.binding.get_host_cpu_features()
    names = {"avx512f": "AVX-512", "avx2": "AVX2", "avx": "AVX", "neon": "NEON"}
    widest = next((name for key, name in names.items() if features.get(key)), "no wide vectors")
    found = f"{widest}, {host_lanes()} floats a vector, threads: {get_threads()}"
    yield Finding("CPU kernels", OK, found)


def _packages() -> Iterator[Finding]:
    required = [r for r in requires("spike4dgs") or () if "extra ==" not in r]
    names = [re.split(r"[^\w.-]", r, maxsplit=1)[0] for r in required]
    absent = [name for name in names if installed_version(name) is None]
    found = f"not installed: {', '.join(absent)}" if absent else f"the {len(names)} that are required are installed"
    yield Finding("packages", BROKEN if absent else OK, found, f"pip install {' '.join(absent)}" if absent else "")


def _torch() -> Iterator[Finding]:
    import torch

    yield Finding("torch", OK, f"{torch.__version__}, threads: {torch.get_num_threads()}")


def _mitsuba() -> Iterator[Finding]:
    from spike4dgs.generators.rendering.mitsuba_variant import diagnose

    variant, installed = diagnose(), version("mitsuba")
    numbers = [re.search(r"\d+", Path(path).name) for path in variant.llvm]
    llvm = ", ".join(sorted({n[0] for n in numbers if n}, key=int)) or "not found"
    if not variant.why_not_fast:
        yield Finding("mitsuba", OK, f"{installed}, {variant.name}; LLVM {llvm}")
        return
    found = f"{installed}, {variant.name}, about 5 times slower than with LLVM: {variant.why_not_fast}"
    if os.environ.get("DRJIT_LIBLLVM_PATH"):
        fix = "unset DRJIT_LIBLLVM_PATH, or name a libLLVM 19 in it"
    else:
        fix = "apt-get install libllvm19, or name a libLLVM 19 in DRJIT_LIBLLVM_PATH"
    yield Finding("mitsuba", MISSING, found, fix)


def _gpu() -> Iterator[Finding]:
    import torch

    if not torch.cuda.is_available():
        if ctypes.util.find_library("cuda"):
            yield Finding("GPU", MISSING, f"an NVIDIA driver, but torch {torch.__version__} sees no device", PYTORCH)
        else:
            yield Finding("GPU", NOTE, "no CUDA device; everything runs on the CPU")
        numba = f"numba-cuda {installed_version('numba-cuda') or 'none'}; only a CUDA device needs it"
        yield Finding("CUDA kernels", NOTE, numba)
        return
    names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    yield Finding("GPU", OK, f"{', '.join(names)} (CUDA {torch.version.cuda})")
    if missing := missing_rasterizer():
        found = f"renders on the CPU: needs {missing.expected}, found {missing.found}"
        yield Finding("CUDA kernels", MISSING, found, missing.fix)
    else:
        found = f"numba-cuda {installed_version('numba-cuda')}; a kernel was compiled and run"
        yield Finding("CUDA kernels", OK, found)


def _optional() -> Iterator[Finding]:
    optional = [(p, installed_version(p), f"pip install 'spike4dgs[{extra}]'", why) for p, extra, why in OPTIONAL]
    for library, package, purpose in LIBRARIES:
        optional.append((package, ctypes.util.find_library(library), f"apt-get install {package}", purpose))
    for name, found, fix, purpose in optional:
        yield Finding(name, OK if found else MISSING, f"{found or 'none'}, for {purpose}", "" if found else fix)


def _metrics() -> Iterator[Finding]:
    for name, file in METRIC_WEIGHTS:
        yield _file(name, file)


def _published() -> Iterator[Finding]:
    from spike4dgs.baselines.images.published.makers import SCFLOW, SPIKECLIP, SSIR, SSML

    for name, network in (("SSML", SSML), ("SSIR", SSIR), ("SpikeCLIP", SPIKECLIP), ("SCFlow", SCFLOW)):
        yield _file(name, network.file)


def _file(name: str, file: WeightFile) -> Finding:
    """Return whether a weight file is here."""
    try:
        return Finding(name, OK, find_weights(file).path.name)
    except WeightsError:
        damaged = any(path.is_file() for path in file.candidates)
        found = f"another or a damaged {file.name}" if damaged else f"no {file.name}"
    by_hand = f"save the state dict of the network of {file.source} as {_short(file.candidates[0])}"
    return Finding(name, MISSING, found, f"spike4dgs {file.command}" if file.command else by_hand)


def _short(path: Path) -> str:
    """Return a path with ~ for the home folder."""
    return f"~/{path.relative_to(Path.home())}" if path.is_relative_to(Path.home()) else str(path)


def _network(name: str, find: Callable[[], Path]) -> Iterator[Finding]:
    try:
        yield Finding(name, OK, find().name)
    except WeightsError as e:
        yield Finding(name, MISSING, "no weights", str(e).rpartition("; ")[2])


def _weights(network: str) -> Path:
    """Return the file of a network's weights, which is imported here: a room that cannot be imported is a finding."""
    if network == "DUSt3R":
        from spike4dgs.baselines.starts.dust3r import weights_path

        return weights_path()
    if network == "MSDI":
        from spike4dgs.method.msdi.weights import WEIGHTS as msdi

        return msdi.check()
    if network == "MSDI's images":
        from spike4dgs.method.image_network.weights import WEIGHTS as images

        return images.check()
    if network == "matching":
        from spike4dgs.method.matching.weights import WEIGHTS as matching

        return matching.check()
    from spike4dgs.baselines.images.spk2img.maker import WEIGHTS as spk2img

    return spk2img.check()


# What finds the weights of a network, or raises UserError.
_NETWORKS = ("MSDI", "MSDI's images", "matching", "Spk2ImgNet", "DUSt3R")
NETWORKS: dict[str, Callable[[], Path]] = {name: partial(_weights, name) for name in _NETWORKS}


def _print(console: Console, finding: Finding, indent: int) -> None:
    """Print a finding, and the line that fixes it unbroken, so that it can be copied."""
    lines = textwrap.wrap(finding.found, console.width - indent - 10) or [""]
    line = Text(f"{finding.part:<{indent}}")
    line.append(f"{finding.state:<9}", _STYLES[finding.state])
    line.append(f"\n{'':<{indent + 9}}".join(lines))
    console.print(line)
    if finding.fix:
        console.print(Text(f"    > {finding.fix}"), soft_wrap=True)
