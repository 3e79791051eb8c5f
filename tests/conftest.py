"""Fixtures of all tests. Helper modules lie in `tests/support`, which pytest puts on the path."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_scenes import write_small_scene


@pytest.fixture
def small_scene(tmp_path: Path) -> Path:
    return write_small_scene(tmp_path / "scene")
