"""Versions, machine, device and commit of a run, recorded beside every number so that it can be reproduced.

The judgement whether Gaussians can be rendered on CUDA here, by numba-cuda, which compiles without a toolkit.

The compiler comes with the package's extra for a version of CUDA. Whether it, the driver and PyTorch go together is
known only from a trial, so one is made: a kernel of one line, compiled and run on a tensor.
"""

from __future__ import annotations

import os
import platform
import re
import shlex
import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import psutil

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.machine.quota import quota_cores

PYTORCH = "install PyTorch with CUDA from pytorch.org"


@dataclass(frozen=True)
class Missing:
    """A part that rendering on CUDA needs and this machine lacks, and what to do."""

    expected: str
    found: str
    fix: str


def install_line() -> str:
    """Return the line that installs numba-cuda with the compiler for PyTorch's version of CUDA."""
    import torch

    extra = "cuda12" if (torch.version.cuda or "").startswith("12.") else "cuda"
    return f"pip install 'spike4dgs[{extra}]'"


def missing_rasterizer(device: str = "cuda") -> Missing | None:
    """Return the first part that rendering on a CUDA device lacks here; None where it works. PyTorch must see it."""
    import torch

    if find_spec("numba_cuda") is None:
        return Missing("the package numba-cuda", "none", install_line())
    if torch.version.cuda is None:
        return Missing("a PyTorch with CUDA", f"torch {torch.__version__}", PYTORCH)
    theirs, ours = torch.version.cuda.partition(".")[0], (installed_version("cuda-bindings") or "").partition(".")[0]
    if ours and ours != theirs:  # both would be loaded into one process
        fix = install_line() if theirs in ("12", "13") else f"install a PyTorch for CUDA {ours} from pytorch.org"
        return Missing(f"numba-cuda for CUDA {theirs}, which PyTorch is for", f"that for CUDA {ours}", fix)
    failure = trial(device)
    if failure:
        return Missing("a numba-cuda that works with the driver", failure, f"{install_line()}, or update the driver")
    return None


@contextmanager
def numba_stream(device: Any) -> Iterator[Any]:
    """Make a torch device numba's own, and yield torch's present stream there as numba's.

    Torch's guard is the outer one: numba's leaves its own device behind where the thread had none of numba's before.
    """
    import torch

    cuda: Any = import_module("numba.cuda")
    with torch.cuda.device(device), cuda.gpus[torch.cuda.current_device()]:
        yield cuda.external_stream(torch.cuda.current_stream().cuda_stream)


@cache
def trial(device: str = "cuda") -> str:
    """Compile a kernel and run it as the rasteriser does; return what fails, or nothing.

    That is on the device that is asked for, on a stream of torch, and in a backward pass too, which has its own thread.
    The first render may be one without gradients; the trial's are needed there too.
    """
    import torch

    try:
        cuda: Any = import_module("numba.cuda")

        def add_one(a: Any) -> None:
            a[0] += 1

        kernel = cuda.jit(add_one)

        def added(tensor: Any) -> Any:
            made = tensor.detach().clone()
            with numba_stream(made.device) as stream:
                kernel[1, 1, stream](cuda.as_cuda_array(made, sync=False))
            return made

        one: Any = torch.ones(1, device=device, requires_grad=True)
        one.register_hook(added)  # called with the gradient, in the backward pass
        stream: Any = torch.cuda.Stream(one.device)  # type: ignore[no-untyped-call]
        with torch.cuda.device(one.device), torch.cuda.stream(stream), torch.enable_grad(), warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*Grid size")  # of one block, which is no news to the user
            two = added(one)
            (1 * one).backward()
            torch.cuda.synchronize()
        return "" if two.item() == one.grad.item() == 2 else "a wrong sum"
    except Exception as e:  # the driver, the compiler and their bindings each have their own
        return f"{type(e).__name__}: {str(e).strip().partition(chr(10))[0]}"


# The libraries whose version can change a score or a speed.
_PACKAGES = (
    "spike4dgs torch numpy scipy numba mitsuba drjit OpenEXR scikit-image"
    " opencv-contrib-python-headless pycolmap numba-cuda"
)


def environment(device: str) -> dict[str, Any]:
    """Return Python, platform, package versions, CPU, and the GPU if `device` is one (null otherwise)."""
    gpu, cuda = _gpu(device) if device_type(device) == "cuda" else (None, None)
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": {name: found for name in _PACKAGES.split() if (found := installed_version(name))},
        "cpu": cpu_name(),
        "gpu": gpu,
        "cuda": cuda,
    }


@cache
def harness() -> dict[str, Any]:
    """Return the version of this package, with commit and dirty flag of a git checkout (null where it is installed)."""
    here = Path(__file__).resolve()
    commit, dirty = None, None
    # An environment inside a checkout is not the checkout: only a tracked file tells the commit it came from.
    if _git(here.parent, "ls-files", "--error-unmatch", here.name) is not None:
        commit = _git(here.parent, "rev-parse", "HEAD")
        changes = _git(here.parent, "status", "--porcelain", "--untracked-files=no", ":/")
        dirty = None if changes is None else bool(changes)
    return {"version": installed_version("spike4dgs") or "0", "commit": commit, "dirty": dirty}


def command_line() -> str:
    """Return the command as typed, with the program's name without its folder."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


def utc(time: datetime) -> str:
    """Return a time as ISO 8601 in UTC, such as 2026-01-31T12:00:00Z."""
    return time.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def utc_now() -> str:
    """Return the time now, as `utc` does."""
    return utc(datetime.now(UTC))


def device_type(device: str) -> str:
    """Return the kind of a device: `cuda` for `cuda:1`, `cpu` for `cpu`."""
    return device.partition(":")[0]


def choose_device(device: str, *, rasterizes: bool = True) -> str:
    """Resolve `auto` and check that the device exists. Raises UserError where it does not.

    What `rasterizes` computes on CUDA only where numba-cuda works too. Without it `auto` is the CPU, and one line on
    stderr says how to change that. `mps` is the CPU too, with a line.
    """
    kind = device_type(device)
    if kind not in ("auto", "cpu", "cuda", "mps"):
        raise problem("--device", "auto, cpu or cuda", repr(device), "choose one of them")
    if kind == "mps":
        _say_once("spike4dgs: computing on the CPU: the kernels run on CPUs and on CUDA, not on Apple's GPU (mps)")
        return "cpu"
    if kind == "cpu":
        return device
    import torch

    if kind == "auto":
        if not torch.cuda.is_available():
            return "cpu"
        if rasterizes and (missing := missing_rasterizer()):
            _say_once(
                f"spike4dgs: computing on the CPU: PyTorch sees a CUDA device, but rendering on it needs "
                f"{missing.expected}, found {missing.found}; {missing.fix}; or silence this with --device cpu"
            )
            return "cpu"
        return "cuda"
    index = device.partition(":")[2] if ":" in device else "0"
    if not index.isdigit() or int(index) >= torch.cuda.device_count():
        raise problem("--device", "a CUDA device of this machine", repr(device), "use --device cpu")
    if rasterizes and (missing := missing_rasterizer(device)):
        raise problem(f"--device {device}", missing.expected, missing.found, f"{missing.fix}; or use --device cpu")
    return device


def reset_peak_memory(device: str) -> None:
    """Start a new measurement of `peak_memory_mb`."""
    if device_type(device) == "cuda":
        import torch

        # Before the first use of the device there is nothing to reset, which would be an error.
        torch.cuda.init()  # type: ignore[no-untyped-call]
        torch.cuda.reset_peak_memory_stats(device)
        return
    try:
        Path("/proc/self/clear_refs").write_text("5")  # Linux: sets the high-water mark back to the present size
    except OSError:
        return


def peak_memory_mb(device: str) -> float | None:
    """Return the peak memory since the reset in MB: of the GPU for a CUDA device, of the whole process otherwise.

    None where the system does not tell (only Linux does for a process).
    """
    if device_type(device) == "cuda":
        import torch

        return float(torch.cuda.max_memory_allocated(device) / 1e6)
    try:
        found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    except OSError:
        return None
    return int(found[1]) * 1024 / 1e6 if found else None


@cache
def _say_once(line: str) -> None:
    print(line, file=sys.stderr)


def installed_version(package: str) -> str | None:
    """Return the version of an installed package; None where it is not."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def cpu_name() -> str:
    """Return the processor and the cores that this process may use."""
    try:
        facts = Path("/proc/cpuinfo").read_text()
    except OSError:
        facts = ""
    return f"{processor(facts)}, {available_cores()} cores"


def processor(cpuinfo: str) -> str:
    """Return the processor that `/proc/cpuinfo` tells of, with family and model where it has them.

    The name alone is not enough: clouds call three generations "AMD EPYC", and a fit takes three times as long on one.

    >>> processor("cpu family : 26\\nmodel : 2\\nmodel name : AMD EPYC")
    'AMD EPYC (family 26, model 2)'
    """
    lines = re.findall(r"^(model name|cpu family|model)[ \t]*:[ \t]*(\S.*)$", cpuinfo, re.M)
    found: dict[str, str] = dict(lines)  # of all cores, the last one's
    kind = f" (family {found['cpu family']}, model {found['model']})" if {"cpu family", "model"} <= set(found) else ""
    return found.get("model name", platform.machine()).strip() + kind


def available_cores() -> int:
    """Return the number of cores that this process may use; those of the machine where the system does not tell."""
    if hasattr(os, "sched_getaffinity"):  # Linux: a call that hot paths afford; psutil reads files first
        cores = len(os.sched_getaffinity(0))
        return min(cores, quota_cores() or cores)
    process = psutil.Process()
    return len(process.cpu_affinity()) if hasattr(process, "cpu_affinity") else psutil.cpu_count() or 1


def _gpu(device: str) -> tuple[str, str | None]:
    import torch

    return torch.cuda.get_device_name(device), torch.version.cuda


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
