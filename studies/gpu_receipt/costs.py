"""What a render and a training step of random Gaussians take: calls, waits for the device, operations."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from spike4dgs.method.splat import Splats, Views, render
from spike4dgs.method.splat.ssim import l1_and_ssim
from spike4dgs.studies.speed_error.gaussians import random_scene

_PROFILED, _OPERATIONS = 5, 12  # steps; operations that are named
_WAITS = "called a synchronizing CUDA operation"  # of torch's warning

Call = Callable[[], object]


def make_scene(device: str, gaussians: int, views: int) -> tuple[Splats, Views]:
    """Return random Gaussians before an array of cameras 5 cm apart."""
    splats, one = random_scene(gaussians)
    w2c = one.w2c.repeat(views, 1, 1)
    w2c[:, 0, 3] = 0.05 * (torch.arange(views) - (views - 1) / 2)
    placed = Views(w2c.to(device), one.K.repeat(views, 1, 1).to(device), one.width, one.height)
    return Splats(*(t.to(device).requires_grad_() for t in splats.tensors)), placed


def render_call(splats: Splats, views: Views) -> Call:
    """Return a call that renders without gradients."""

    def image() -> object:
        with torch.no_grad():
            return render(splats, views).image

    return image


def step_call(splats: Splats, views: Views) -> Call:
    """Return a call that renders, compares with random images, and differentiates."""
    target = torch.rand(len(views), views.height, views.width, device=splats.means.device)

    def step() -> object:
        loss = l1_and_ssim(render(splats, views).image[..., 0], target, 0.2)
        return torch.autograd.grad(loss, splats.tensors)

    return step


def finished(call: Call, device: str) -> Call:
    """Return a call that ends when the device has."""

    def done() -> object:
        made = call()
        if device.startswith("cuda"):
            torch.cuda.synchronize(device)
        return made

    return done


def waits(call: Call, device: str) -> list[dict[str, Any]]:
    """Return the lines at which a call waits for the device, and how often; none on the CPU."""
    if not device.startswith("cuda"):
        call()
        return []
    torch.cuda.set_sync_debug_mode("warn")
    try:
        return waits_told(call)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def waits_told(call: Call) -> list[dict[str, Any]]:
    """Return where torch warned that a call waits: files by their last folder and name."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        call()
    lines = Counter(f"{'/'.join(Path(w.filename).parts[-2:])}:{w.lineno}" for w in told if _WAITS in str(w.message))
    return [{"where": where, "count": count} for where, count in lines.most_common()]


def operations(call: Call, device: str) -> list[dict[str, Any]]:
    """Return the operations of a call that take longest on the device, and ms of each in a call."""
    from torch.profiler import ProfilerActivity, profile

    on_gpu = device.startswith("cuda")
    with profile(activities=[ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if on_gpu else [])]) as found:
        for _ in range(_PROFILED):
            call()
    kind = "self_device_time_total" if on_gpu else "self_cpu_time_total"
    rows = sorted(found.key_averages(), key=lambda row: -float(getattr(row, kind)))
    return [
        {"name": row.key[:200], "calls": row.count / _PROFILED, "ms": float(getattr(row, kind)) / 1e3 / _PROFILED}
        for row in rows[:_OPERATIONS]
    ]
