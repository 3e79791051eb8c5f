"""Scenes and a release of them, in a few shards."""

from pathlib import Path

import pytest
from release_scenes import write_release_scenes

from spike4dgs.benchmark.release.index import Release
from spike4dgs.benchmark.release.pack import pack
from spike4dgs.benchmark.scene.scene import open_scenes


@pytest.fixture(scope="session")
def scene_folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    return write_release_scenes(tmp_path_factory.mktemp("scenes"))


@pytest.fixture(scope="session")
def packed(scene_folders: tuple[Path, ...], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Release]:
    """A release of two scenes, in shards of about 6 MB."""
    out = tmp_path_factory.mktemp("release") / "1"
    return out, pack(open_scenes(scene_folders), out, "1", 6_000_000)


@pytest.fixture
def release_folder(packed: tuple[Path, Release]) -> Path:
    return packed[0]


@pytest.fixture
def release(packed: tuple[Path, Release]) -> Release:
    return packed[1]
