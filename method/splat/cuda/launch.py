"""Launching numba's CUDA kernels on torch tensors: on torch's current stream, or in numba's simulator.

With NUMBA_ENABLE_CUDASIM=1 numba runs a kernel as Python threads on NumPy arrays. That shows the arithmetic on a
machine without a device, slowly, and nothing else: neither the compilation nor the speed.
"""

from __future__ import annotations

import warnings
from typing import Any

import torch
from numba.core import config
from torch import Tensor

# A small image has few tiles. That a grid could be larger is no news to the user.
warnings.filterwarnings("ignore", message=".*Grid size")


def simulated() -> bool:
    """Return whether numba runs CUDA kernels in its simulator, which takes tensors of the CPU."""
    return bool(config.ENABLE_CUDASIM)  # type: ignore[attr-defined, unused-ignore]


def launch(kernel: Any, blocks: int, threads: int, device: torch.device, *arguments: Any) -> None:
    """Run `kernel` on a grid of `blocks` x `threads`; tensors among the arguments are passed as arrays."""
    if blocks == 0:
        return
    if simulated():
        kernel[blocks, threads](*(a.detach().numpy() if isinstance(a, Tensor) else a for a in arguments))
        return
    from numba import cuda

    with cuda.gpus[device.index or 0]:
        stream = cuda.external_stream(torch.cuda.current_stream(device).cuda_stream)
        arrays = (cuda.as_cuda_array(a.detach(), sync=False) if isinstance(a, Tensor) else a for a in arguments)
        kernel[blocks, threads, stream](*arrays)
