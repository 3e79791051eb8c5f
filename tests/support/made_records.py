"""A record of the sweep, for tests of what is made of them."""

from typing import Any


def record(**changes: Any) -> dict[str, Any]:
    """A record with numbers of usual length."""
    metrics = {"psnr": 34.3612, "ssim": 0.973512, "psnr_dynamic": 32.0612, "ssim_dynamic": 0.967912}
    metrics |= {"flip": 0.0531234, "lpips_alex": 0.0912345, "lpips_vgg": 0.123456, "temporal_error": 0.0123456}
    cell = {"row": "spike4dgs-x+self-calibrated", "scene": "turntable-0-small", "revision": "0123456789ab"}
    cell |= {"seed": 0, "budget": 1.0, "split": "center", "commit": "0123456789ab", "code": "ba9876543210"}
    cell |= {"tuned_on": "release 1, variants 0, few trials", "knowledge": "uncalibrated", "quiet": False}
    costs = {"fit_seconds": 73.1234, "render_fps": 180.123, "peak_memory_mb": 1012.12}
    machine = {"cpu": "AMD EPYC 7763 64-Core Processor, 2 cores"}
    return {**cell, "metrics": metrics, **costs, **machine, "error": None, **changes}
