"""Image quality without a reference image: BRISQUE and NIQE, with LIVE's published parameters (see NOTICE)."""

from spike4dgs.benchmark.metrics.iqa.brisque import brisque
from spike4dgs.benchmark.metrics.iqa.niqe import niqe

__all__ = ["brisque", "niqe"]
