"""`doctor --gpu-receipt FILE`: a GPU's tests and a timing, in one JSON file that its owner can send.

The file names the card, the driver and the versions of the libraries; it names no user, host or folder.
"""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import torch

from spike4dgs.benchmark.environment import PYTORCH, environment, harness, missing_rasterizer, utc_now
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import write_json
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.studies.gpu_receipt.costs import finished, make_scene, operations, render_call, step_call, waits
from spike4dgs.studies.gpu_receipt.device_tests import counted, passed, run_tests
from spike4dgs.studies.kit.checkout import find_checkout
from spike4dgs.studies.kit.timing import by_turns_ms

FORMAT = "spike4dgs-gpu-receipt/1"
TESTS = "tests/method/splat/cuda/test_device.py"
_GAUSSIANS, _VIEWS, _REPEATS = 45_000, 8, 20  # as in what was estimated of a step without a device


def gpu_receipt(out: Path) -> int:
    """Run the tests of the device and a timing on the first GPU, and write the receipt; see `doctor`."""
    require_gpu()
    root = find_checkout("--gpu-receipt")
    print(f"tests of the device ({TESTS}), some minutes ...", flush=True)
    tests = run_tests(root, TESTS)
    print(f"{counted(tests)}\ntiming ...", flush=True)
    receipt = make_receipt("cuda", tests, _GAUSSIANS, _VIEWS, _REPEATS)
    write_json(out, receipt)
    for row in receipt["timing"]:
        print(f"{row['what']}: {row['median_ms']:.2f} ms")
    print(f"waits for the device in a training step: {sum(w['count'] for w in receipt['waits'])}\nreceipt: {out}")
    return int(not passed(tests))


def require_gpu() -> None:
    """Raise UserError where PyTorch sees no GPU, or its kernels cannot run there."""
    if not torch.cuda.is_available():
        found = f"none that torch {torch.__version__} sees"
        raise problem("--gpu-receipt", "an NVIDIA GPU", found, f"run it where there is one; {PYTORCH}")
    if missing := missing_rasterizer():
        raise problem("--gpu-receipt", missing.expected, missing.found, missing.fix)


def make_receipt(device: str, tests: dict[str, Any], gaussians: int, views: int, repeats: int) -> dict[str, Any]:
    """Return the receipt of a device: the outcome of its tests, and what a render and a training step take there."""
    started, scene = utc_now(), make_scene(device, gaussians, views)
    image, step = render_call(*scene), step_call(*scene)
    of = f"{views} views of {scene[1].width}x{scene[1].height}, {gaussians} Gaussians"
    calls = {f"render {of}": image, f"training step (L1, SSIM, gradients), {of}": step}
    times = by_turns_ms([finished(call, device) for call in calls.values()], repeats)
    receipt = {
        "format": FORMAT,
        "created": started,
        "harness": harness(),
        "environment": environment(device),
        "device": device_facts(device),
        "tests": tests,
        "timing": [
            {"what": what, "least_ms": least, "median_ms": median, "repeats": repeats}
            for what, (least, median) in zip(calls, times, strict=True)
        ],
        "waits": waits(step, device),
        "operations": operations(finished(step, device), device),
    }
    check_schema(
        receipt, load_schema("spike4dgs.studies.gpu_receipt", "gpu_receipt.schema.json"), "the receipt", "report this"
    )
    return receipt


def device_facts(device: str) -> dict[str, Any]:
    """Return what tells one card from another."""
    if not device.startswith("cuda"):
        return {"name": device, "capability": None, "memory_gb": None, "multiprocessors": None, "driver": None}
    found = torch.cuda.get_device_properties(device)
    return {
        "name": found.name,
        "capability": f"{found.major}.{found.minor}",
        "memory_gb": round(found.total_memory / 1e9, 1),
        "multiprocessors": found.multi_processor_count,
        "driver": _driver(),
    }


def _driver() -> str | None:
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        told = subprocess.run(command, capture_output=True, text=True, timeout=30).stdout.split()
    except (OSError, subprocess.SubprocessError):
        return None
    return told[0] if told else None
