"""The choice of the Mitsuba variant: the vectorised LLVM variant where it works, else the scalar one.

`llvm_ad_rgb` needs a system libLLVM that suits the CPU; an unsuitable one kills the process. A child process therefore
tries it once, and the result is cached for this Mitsuba, this libLLVM and this CPU.
"""

from __future__ import annotations

import glob
import hashlib
import json
import os
import platform
import signal
import subprocess
import sys
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import user_cache

FAST, SAFE = "llvm_ad_rgb", "scalar_rgb"
SUPPORTED = (FAST, SAFE, "cuda_ad_rgb")
OVERRIDE = "SPIKE4DGS_MITSUBA_VARIANT"

_LLVM_PATHS = (
    "/usr/lib/*/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/local/lib/libLLVM*",
    "/opt/homebrew/opt/llvm/lib/libLLVM*",
)
_CUDA_PATHS = ("/usr/lib/*/libcuda.so*", "/usr/lib64/libcuda.so*", "/usr/lib/wsl/lib/libcuda.so*")
_PROBE = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import numpy as np
scene = mi.load_dict(mi.cornell_box())
image = np.array(mi.render(scene, spp=1, sensor=0))
assert np.isfinite(image).all() and image.mean() > 0
print("works")
"""


@lru_cache(maxsize=1)
def pick_variant() -> str:
    """Return the variant for this process: `SPIKE4DGS_MITSUBA_VARIANT` where set, else the probe's answer.

    If it falls back to the scalar variant, one line on stderr gives the reason and how to make rendering faster.
    Raises UserError for an unknown name in the environment variable, or a variant that does not work here.
    """
    wanted = os.environ.get(OVERRIDE)
    if wanted:
        if wanted not in SUPPORTED:
            raise problem(OVERRIDE, " or ".join(SUPPORTED), wanted, "unset it to let the program choose")
        if wanted == FAST and (why_not := _cached_probe()):
            fix = "install libLLVM 19 (Debian: apt-get install libllvm19), or unset it"
            raise problem(OVERRIDE, f"a libLLVM with which {FAST} works", why_not, fix)
        return wanted
    why_not = _cached_probe()
    if not why_not:
        return FAST
    print(
        f"spike4dgs: rendering with {SAFE} because {FAST} does not work here ({why_not}); for about "
        "5 times the speed install libLLVM 19 (Debian: apt-get install libllvm19) or name one in DRJIT_LIBLLVM_PATH",
        file=sys.stderr,
    )
    return SAFE


@dataclass(frozen=True)
class Variant:
    """The variant that `make-dataset` renders with, and why it is not the fast one ("" if it is, or was asked for)."""

    name: str
    why_not_fast: str
    llvm: tuple[str, ...]  # the libLLVM files found, or the one that DRJIT_LIBLLVM_PATH names


def diagnose() -> Variant:
    """Return what `pick_variant` picks, without its line on stderr; raises as it does."""
    llvm = tuple(_llvm_files())
    if os.environ.get(OVERRIDE):
        return Variant(pick_variant(), "", llvm)
    why_not = _cached_probe()
    return Variant(SAFE if why_not else FAST, why_not, llvm)


def choose_device(device: str) -> None:
    """Let this process and its children render on "cpu" or "cuda"; "auto" leaves it to the environment variable.

    Raises UserError for "cuda" where there is no NVIDIA driver.
    """
    if device == "auto":
        return
    if device == "cuda" and not any(glob.glob(path) for path in _CUDA_PATHS):
        raise problem("--device cuda", "an NVIDIA GPU with its driver", "no libcuda", "use --device cpu")
    chosen = os.environ.get(OVERRIDE, "")
    if device == "cuda":
        os.environ[OVERRIDE] = "cuda_ad_rgb"
    elif chosen.startswith("cuda"):
        del os.environ[OVERRIDE]
    pick_variant.cache_clear()


def load_mitsuba() -> ModuleType:
    """Return the mitsuba module with its variant set; the first call decides for the whole process."""
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant(pick_variant())
        mi.set_log_level(mi.LogLevel.Error)  # it warns of every sliver among the triangles
    return mi


def _cached_probe() -> str:
    """Return why the fast variant fails ("" if it works), from the cache file or from a new probe.

    A failure that may be due to a moment's load or lack of memory is not kept, nor one where no file of LLVM was found:
    a later installation would not show.
    """
    path = user_cache() / f"mitsuba-{_fingerprint()}.json"
    try:
        return str(json.loads(path.read_text())["why_not"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    why_not, passing = _probe()
    if passing or (why_not and not _llvm_files()):
        return why_not
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = path.with_suffix(f".{os.getpid()}.tmp")
        scratch.write_text(json.dumps({"why_not": why_not}))
        scratch.replace(path)
    except OSError:
        pass  # no writable cache: the next process probes again
    return why_not


def _probe(timeout_s: float = 180.0) -> tuple[str, bool]:
    """Render a small image in a child process.

    Return "" or one line that says what went wrong, and whether it may go right another time.
    """
    try:
        child = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, text=True, timeout=timeout_s)
    except subprocess.TimeoutExpired:
        return f"no answer within {timeout_s:.0f} s", True
    if child.returncode == 0 and "works" in child.stdout:
        return "", False
    complaint = [line.strip() for line in child.stderr.splitlines() if line.strip()]
    if child.returncode < 0:
        why_not = f"killed by {signal.Signals(-child.returncode).name}" + (f", {complaint[0]}" if complaint else "")
        return why_not, child.returncode == -signal.SIGKILL  # as the system does where memory is short
    return complaint[-1] if complaint else f"exit code {child.returncode}", False


def _fingerprint() -> str:
    """Return a name for this Mitsuba, the libLLVM files that it would find, and the CPU."""
    stamps = [(f, os.stat(f).st_size if os.path.exists(f) else -1) for f in _llvm_files()]
    facts = (version("mitsuba"), version("drjit"), stamps, platform.machine(), _cpu_name())
    return hashlib.sha256(repr(facts).encode()).hexdigest()[:16]


def _llvm_files() -> list[str]:
    named = os.environ.get("DRJIT_LIBLLVM_PATH", "")
    return [named] if named else sorted({f for path in _LLVM_PATHS for f in glob.glob(path)})


def _cpu_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")
