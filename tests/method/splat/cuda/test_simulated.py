"""The CUDA kernels in numba's simulator against the float64 reference, on any machine."""

import os
import subprocess
import sys
from pathlib import Path

SUPPORT = Path(__file__).resolve().parents[3] / "support"
# All in one process, because it starts slowly; hard scenes by the name of their function in splat_scenes.
CASES = ["near_plane", "needles", "pancakes", "tiny_and_huge", "opacities", "equal_depths", "off_screen", "nothing"]
CASES += ["far_origin", "opaque_stack", "zero_quaternions", "one channel", "three channels with depth", "five channels"]
CASES += ["barrel", "cushion", "tangential", "behind and over", "same bits"]


def test_images_and_gradients() -> None:
    done = subprocess.run(
        [sys.executable, str(SUPPORT / "cuda_simulator.py"), *CASES],
        env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines() == CASES
