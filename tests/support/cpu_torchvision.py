"""torchvision next to a PyTorch for CPUs alone.

Its wheel needs compiled operators that such a PyTorch lacks; its import refers to two of them. They are declared here,
without being used, so that its networks and transforms (plain torch) can be imported.
"""

import sys

import torch


def import_torchvision() -> None:
    """Import torchvision; after that `import torchvision` works everywhere in the process."""
    try:
        import torchvision  # noqa: F401
    except RuntimeError:
        for name in [m for m in sys.modules if m.startswith("torchvision")]:
            del sys.modules[name]
        operators = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            operators.define(f"{name}(Tensor boxes, Tensor scores, float threshold) -> Tensor")
        import torchvision  # noqa: F401
