"""The scenes of a track: found, fetched, or refused."""

import shutil
from pathlib import Path

import pytest
from range_server import serve

from spike4dgs.benchmark import Scene, UserError
from spike4dgs.benchmark.release import source as source_module
from spike4dgs.benchmark.release.index import Release
from spike4dgs.benchmark.release.scenes import track_folders
from spike4dgs.benchmark.release.selection import Selection
from spike4dgs.cli import download as command


@pytest.fixture
def revisions(release: Release) -> dict[str, str]:
    return {scene: entry.revision for scene, entry in release.scenes.items()}


def never(scene: Scene) -> bool:
    return False


def test_what_is_missing_is_fetched(
    revisions: dict[str, str], release_folder: Path, scene_folders: tuple[Path, ...], tmp_path: Path
) -> None:
    shutil.copytree(scene_folders[0], tmp_path / "pattern-0")
    with serve(release_folder) as (address, seen):
        assert track_folders(revisions, tmp_path, address, never) == (tmp_path / "pattern-0", tmp_path / "pattern-1")
        assert seen.requests
        seen.requests.clear()
        track_folders(revisions, tmp_path, address, never)
        assert not seen.requests, "nothing is missing now"
        (tmp_path / "pattern-1/spikes/cam_00.dat").unlink()
        track_folders(revisions, tmp_path, address, never)
        assert (tmp_path / "pattern-1/spikes/cam_00.dat").is_file()


def test_another_revision_is_refused(
    revisions: dict[str, str], release_folder: Path, scene_folders: tuple[Path, ...], tmp_path: Path
) -> None:
    shutil.copytree(scene_folders[0], tmp_path / "pattern-0")
    other = revisions | {"pattern-0": "0" * 64}
    with pytest.raises(UserError, match=f"pattern-0: expected revision {'0' * 64} of the track, found"):
        track_folders(other, tmp_path, str(release_folder), never)
    accepted = track_folders(other, tmp_path, str(release_folder), lambda scene: scene.id == "pattern-0")
    assert accepted[0] == tmp_path / "pattern-0", "an equivalent scene"
    with pytest.raises(UserError, match=f"expected pattern-0 in revision {'0' * 64}, found .*; name another release"):
        track_folders(other, tmp_path / "new", str(release_folder), never)
    with pytest.raises(UserError, match="expected moon-0 in revision 11, found no such scene"):
        track_folders({"moon-0": "11"}, tmp_path / "new", str(release_folder), never)


def test_no_server_names_the_scenes(revisions: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(source_module.VARIABLE, raising=False)
    with pytest.raises(UserError, match="a release with pattern-0, pattern-1, found none; there is no public server"):
        track_folders(revisions, tmp_path, None, never)


def test_the_command_takes_a_tracks_scenes(
    revisions: dict[str, str], release_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "track_scenes", lambda name: {"pattern-1": revisions["pattern-1"]})
    source = str(release_folder)
    assert command.download("outdoor", source=source, out=tmp_path, selection=Selection(parts=("images",))) == 0
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_dir()) == ["pattern-1"]
    with pytest.raises(UserError, match="--scenes of outdoor: expected one of pattern-1, found 'pattern-0'"):
        command.download("outdoor", source=source, out=tmp_path, selection=Selection(scenes=("pattern-0",)))
    monkeypatch.setattr(command, "track_scenes", lambda name: {"pattern-1": "22"})
    with pytest.raises(UserError, match="expected pattern-1 in revision 22"):
        command.download("outdoor", source=source, out=tmp_path / "new")
