"""A device that is not there: tensors that say they are not on the CPU, and errors where the two are mixed.

Inside `pretend_device()` a tensor on the device "meta" holds its numbers in the CPU's memory. What PyTorch refuses on a
GPU is refused here: operations between both, `.numpy()`, and a CPU generator for a tensor of the device. So a path that
works here never forgets to move a tensor. It shows nothing about CUDA itself, and the rasteriser's kernels do not run:
their outputs are filled with a constant.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.optim import optimizer
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map_only

from spike4dgs.method.models import model_file
from spike4dgs.method.splat.cuda import render

DEVICE = "meta"  # a name that PyTorch has for a device without kernels of its own
_MIXED = ("index", "index_put", "index_put_", "_index_put_impl_", "copy_", "_to_copy", "_unsafe_index")


class Pretend(Tensor):
    """A tensor of the pretended device."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> Pretend:
        made = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls, inner.shape, strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype,
            device=DEVICE,
        )  # fmt: skip
        made.inner = inner
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(func, args, kwargs or {})

    def numpy(self, *args: Any, **kwargs: Any) -> Any:
        raise TypeError("can't convert a tensor of the device to numpy")

    __array__ = numpy

    def new_tensor(self, data: Any, dtype: torch.dtype | None = None) -> Tensor:  # type: ignore[override]
        return torch.tensor(data, dtype=dtype or self.dtype, device=DEVICE)

    def __getitem__(self, index: Any) -> Tensor:
        return super().__getitem__(_with_tensors(index))

    def __setitem__(self, index: Any, value: Any) -> None:
        super().__setitem__(_with_tensors(index), value)


def _with_tensors(index: Any) -> Any:
    """Return an index with tensors for lists, which PyTorch would make on the device, where no mode can see it."""
    if isinstance(index, tuple):
        return tuple(map(_with_tensors, index))
    return torch.as_tensor(index) if isinstance(index, list) else index


def run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Run an operation on the numbers of its tensors, if a GPU would; return tensors of the device it runs on."""
    name = func.__name__.split(".")[0]
    tensors = [t for t in tree_leaves((args, kwargs)) if isinstance(t, Tensor)]
    theirs = [t for t in tensors if isinstance(t, Pretend)]
    plain = [t for t in tensors if not isinstance(t, Pretend)]
    if theirs and name not in _MIXED and any(t.ndim for t in plain):
        raise RuntimeError(f"{func}: tensors of both devices, {[tuple(t.shape) for t in plain]} on the CPU")
    on_device = bool(theirs)
    if "device" in kwargs and kwargs["device"] is not None:
        on_device = torch.device(kwargs["device"]).type == DEVICE
        kwargs = {**kwargs, "device": torch.device("cpu")}
    if on_device and kwargs.get("generator") is not None:
        raise RuntimeError(f"{func}: a CPU generator for a tensor of the device")
    if name in ("index_put_", "copy_", "_index_put_impl_") and tensors and not isinstance(args[0], Pretend):
        if name != "copy_" and theirs:
            raise RuntimeError(f"{func}: a tensor of the device put into one of the CPU")
        on_device = False
    if name == "index" and not isinstance(args[0], Pretend) and theirs:
        raise RuntimeError(f"{func}: indices of the device for a tensor of the CPU")
    inner_args, inner_kwargs = tree_map_only(Pretend, lambda t: t.inner, (args, kwargs))
    out = func(*inner_args, **inner_kwargs)
    if not on_device:
        return args[0] if name == "copy_" else out
    wrapped = tree_map_only(Tensor, Pretend, out)
    return return_and_correct_aliasing(func, args, kwargs, wrapped)


class _Mode(TorchDispatchMode):
    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(func, args, kwargs or {})


def _fill(kernel: Any, blocks: int, threads: int, device: torch.device, *arguments: Any) -> None:
    for a in arguments:
        assert not isinstance(a, Tensor) or isinstance(a, Pretend), "a tensor of the CPU for a kernel"
    for out in arguments[-2:] if kernel == "forward" else arguments[-1:]:
        out.fill_(0.01)


@contextmanager
def pretend_device() -> Iterator[str]:
    """Pretend that there is a device; yield its name."""
    make, devices = torch.tensor, optimizer._get_fused_kernels_supported_devices

    def tensor(data: Any, *, device: Any = None, **options: Any) -> Tensor:
        return make(data, **options).to(device or "cpu")  # PyTorch makes the numbers where no mode can see it

    with pytest.MonkeyPatch.context() as patch, _Mode():
        patch.setattr(torch, "tensor", tensor)
        patch.setattr(torch, "autocast", lambda *args, **options: nullcontext())
        patch.setattr(optimizer, "_get_fused_kernels_supported_devices", lambda: [*devices(), DEVICE])
        patch.setattr(render, "launch", _fill)
        patch.setattr(render, "_kernels", lambda channels: ("forward", "backward", "sum"))
        patch.setattr(render, "simulated", lambda: True)
        patch.setattr(model_file, "WITHOUT_MEMORY", torch.device("cpu"))  # that device's name stands for ours here
        yield DEVICE
