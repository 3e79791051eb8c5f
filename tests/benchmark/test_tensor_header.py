"""Headers of safetensors files: bounded before the library parses them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy

from spike4dgs.benchmark.untrusted import MOST_HEADER_BYTES, check_header


def test_headers(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    safetensors.numpy.save_file({"a": np.zeros(3)}, path)
    check_header(path)
    path.write_bytes((MOST_HEADER_BYTES + 1).to_bytes(8, "little") + b"{}")
    with pytest.raises(ValueError, match=f"{MOST_HEADER_BYTES} at most"):
        check_header(path)
    with pytest.raises(OSError, match="no such file"):
        check_header(tmp_path)
