"""The page's boards: the committed entries, and a run of small scenes whose images the page can show."""

from __future__ import annotations

from pathlib import Path

import pytest

from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.leaderboard.page.rows import Board, gather

COMMITTED = Path(__file__).resolve().parents[3] / "leaderboard"


@pytest.fixture(scope="session")
def committed() -> list[Board]:
    """The boards of the committed entries, none of which is refused."""
    boards, refused = gather(COMMITTED, ())
    assert not refused
    return boards


@pytest.fixture(scope="session")
def data(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that has the scenes of the finished run under their ids."""
    folder = tmp_path_factory.mktemp("data")
    for name in ("s0", "s1"):
        (folder / open_scene(finished / name).id).symlink_to(finished / name)
    return folder
