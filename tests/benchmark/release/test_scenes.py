"""Downloads from a local HTTP server that cuts, flips, fails, and from a process that is killed."""

import contextlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from changes import edit_json, exchange, files_in, flip_bit
from fake_hub import REPOSITORY, serve_hub
from range_server import Behaviour, serve
from small_scenes import write_small_scene

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import sha256_file
from spike4dgs.benchmark.release import scenes as scenes_module
from spike4dgs.benchmark.release import source as source_module
from spike4dgs.benchmark.release.index import BLOCK
from spike4dgs.benchmark.release.pack import pack
from spike4dgs.benchmark.release.scenes import Report, download, open_release
from spike4dgs.benchmark.release.selection import Selection
from spike4dgs.benchmark.release.source import Patience, Source
from spike4dgs.benchmark.scene.images import write_exr
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import open_scene, open_scenes
from spike4dgs.benchmark.spikes.folder import open_stream_folder
from spike4dgs.cli import main

HASTE = Patience(first_wait_s=0.001, longest_wait_s=0.002)
WHOLE = Selection()


def fetch(address: str, out: Path, chosen: Selection = WHOLE, workers: int = 4, patience: Patience = HASTE) -> Report:
    source = Source(address, patience)
    return download(source, open_release(source), chosen, out, workers)


def tree(root: Path) -> dict[str, bytes]:
    return {name: data for name, data in files_in(root).items() if name != ".download.lock"}


@pytest.fixture(scope="session")
def whole(packed: tuple[Path, object], tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What a download from the folder itself gives."""
    out = tmp_path_factory.mktemp("whole")
    fetch(str(packed[0]), out)
    return tree(out)


def total(files: dict[str, bytes]) -> int:
    return sum(map(len, files.values()))


def test_scenes_come_out_as_they_were(whole: dict[str, bytes], scene_folders: tuple[Path, ...]) -> None:
    for root in scene_folders:
        for path in root.glob("spikes/*.dat"):
            assert whole[f"{root.name}/spikes/{path.name}"] == path.read_bytes()
    assert {name for name in whole if name.startswith("pattern-1/")} == {
        f"pattern-1/{p.relative_to(scene_folders[1])}" for p in scene_folders[1].rglob("*") if p.is_file()
    }


def test_a_release_whose_truth_was_exchanged_is_refused(tmp_path: Path) -> None:
    root = write_small_scene(tmp_path / "pattern-1")
    gray = np.full((24, 40), 0.5, np.float32)
    exchange(root, "images/cam_03/000040.exr", lambda path: write_exr(path, gray, 2000.0))
    pack(open_scenes([root]), tmp_path / "release", "1", 6_000_000)
    with pytest.raises(UserError, match=r"images/cam_03/000040\.exr: expected content .* the manifest claims another"):
        fetch(str(tmp_path / "release"), tmp_path / "out")


def test_a_release_whose_stream_is_not_the_manifests_is_refused(tmp_path: Path) -> None:
    scene = open_scene(write_small_scene(tmp_path / "pattern-1"))
    stream = scene.root / "spikes/cam_00.dat"
    stream.write_bytes(bytes(stream.stat().st_size))
    scene.manifest.files["spikes/cam_00.dat"] = (
        stream.stat().st_size,
        sha256_file(stream),
    )  # for the shard's list alone
    pack([scene], tmp_path / "release", "1", 6_000_000)
    with pytest.raises(UserError, match=r"spikes/cam_00\.dat: expected the file of manifest\.json, found another one"):
        fetch(str(tmp_path / "release"), tmp_path / "out")


def test_a_window_has_the_scenes_dead_ticks(tmp_path: Path) -> None:
    root = write_small_scene(tmp_path / "pattern-1")
    edit_json(root / "scene.json", lambda meta: meta["sensor"].update(dead_ticks=0.5))
    write_manifest(root)
    pack(open_scenes([root]), tmp_path / "release", "1", 6_000_000)
    report = fetch(str(tmp_path / "release"), tmp_path / "out", Selection(cameras=("cam_01",), window_ms=(1.0, 3.0)))
    assert open_stream_folder(report.folders[0])["cam_01"].dead_ticks == 0.5


@pytest.mark.parametrize("scheme", ["path", "file", "memory"])
def test_fsspecs_file_systems_serve(scheme: str, release_folder: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    address = {"path": str(release_folder), "file": f"file://{release_folder}", "memory": "memory://releases/1"}[scheme]
    if scheme == "memory":
        import fsspec

        fsspec.filesystem("memory").put(str(release_folder), "/releases/1", recursive=True)
    fetch(address, tmp_path)
    assert tree(tmp_path) == whole


def test_hugging_face_serves(release_folder: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    """Through huggingface_hub's own file system, with a server of this machine in the hub's place."""
    pytest.importorskip("huggingface_hub")
    code = "import sys; from spike4dgs.cli import main; sys.exit(main(sys.argv[1:]))"
    command = ["download", "all", "--from", f"hf://datasets/{REPOSITORY}", "--out", str(tmp_path)]
    with serve_hub(release_folder) as (endpoint, seen):
        hub = {"HF_ENDPOINT": endpoint, "HF_HUB_DISABLE_TELEMETRY": "1", "HF_HOME": str(tmp_path.with_suffix(".hub"))}
        done = subprocess.run([sys.executable, "-c", code, *command], env=os.environ | hub, capture_output=True)
    assert done.returncode == 0, done.stderr
    assert tree(tmp_path) == whole
    assert len(seen.asked(".tar")) <= 8 and None not in seen.asked(".tar")


def test_over_http_in_few_requests(release_folder: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    with serve(release_folder) as (address, seen):
        report = fetch(address, tmp_path)
    assert tree(tmp_path) == whole
    assert report.fetched == total(whole)
    assert report.requests == len(seen.requests)
    assert len(seen.asked(".tar")) <= 8, "neighbours share a request"
    again = fetch(str(release_folder), tmp_path)
    assert again.fetched == 0, "nothing is fetched twice"


def test_ten_cuts_cost_nothing_but_time(release_folder: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    with serve(release_folder, Behaviour(cuts=10, cut_after=300_000)) as (address, seen):
        fetch(address, tmp_path, workers=2, patience=replace(HASTE, tries=11))  # all may hit one block
    assert seen.cuts == 0
    assert tree(tmp_path) == whole


def test_flipped_bits_are_fetched_again(release_folder: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    with serve(release_folder, Behaviour(flips=3)) as (address, seen):
        report = fetch(address, tmp_path)
    assert tree(tmp_path) == whole
    assert report.fetched == total(whole), "what was damaged does not count as fetched"
    assert any(asked and _length(asked) <= BLOCK for asked in seen.asked()), "a damaged block is fetched alone"


def _length(asked: str) -> int:
    start, stop = asked.removeprefix("bytes=").split("-")
    return int(stop) + 1 - int(start)


def test_a_damaged_copy_fails_after_three_tries(release_folder: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    described = json.loads(sorted(release_folder.glob("shards/*/*.json"))[0].read_text())
    suffix = Path(described["shard"]).name
    member = next(f for f in described["files"] if f["path"] == "spikes/cam_00.dat")
    with serve(release_folder, Behaviour(suffix, flip_at=member["offset"] + BLOCK + 5)) as (address, _):
        with pytest.raises(UserError, match=r"pattern-0/spikes/cam_00.dat: expected bytes with sha256 .* 3 times"):
            fetch(address, tmp_path)
    assert not (tmp_path / "pattern-0/spikes/cam_00.dat").exists()
    assert not (tmp_path / "pattern-0/manifest.json").exists(), "the scene is unfinished"
    with serve(release_folder) as (address, seen):
        report = fetch(address, tmp_path)
    assert 0 < report.fetched <= total(whole) - BLOCK, "the good blocks of that file stayed"
    assert tree(tmp_path) == whole


def test_a_server_that_is_away_for_a_while(release_folder: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    with serve(release_folder, Behaviour(failures=[503, 429, 500, 408])) as (address, _):
        fetch(address, tmp_path)
    assert tree(tmp_path) == whole
    with serve(release_folder, Behaviour(suffix="", failures=[503] * 50)) as (address, _):
        with pytest.raises(UserError, match=r"release.json: expected an answer, found .*, 8 times in a row; check"):
            fetch(address, tmp_path / "never")


@pytest.mark.parametrize("status", [401, 403, 410])
def test_a_refusal_is_not_tried_again(status: int, release_folder: Path, tmp_path: Path) -> None:
    with serve(release_folder, Behaviour(suffix="", failures=[status] * 9)) as (address, seen):
        with pytest.raises(UserError, match="release.json: expected an answer, found"):
            fetch(address, tmp_path)
        assert len(seen.requests) == 1


def test_no_server_and_no_release(release_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected an answer, found ClientConnectorError"):
        fetch("http://127.0.0.1:1", tmp_path)
    with pytest.raises(UserError, match=r"release.json: expected a file, found no such file; check the address"):
        fetch(str(tmp_path), tmp_path)
    with serve(release_folder) as (address, _), pytest.raises(UserError, match="found no such file"):
        fetch(f"{address}/other", tmp_path)
    with pytest.raises(UserError, match="expected an address"):
        fetch("nonsense://x/y", tmp_path)


def test_a_server_without_ranges_is_refused_in_one_line(release_folder: Path, tmp_path: Path) -> None:
    with serve(release_folder, Behaviour(ranges=False)) as (address, _):
        with pytest.raises(UserError, match="expected a server that sends parts of a file, found one that does not"):
            fetch(address, tmp_path)


def test_a_damaged_index_is_refused(release_folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(release_folder, tmp_path / "copy"))
    path = sorted(copy.glob("shards/*/*.json"))[0]
    path.write_text(path.read_text() + " ")
    with pytest.raises(UserError, match=r"00000.json: expected sha256 .*, found .*; the server's copy is damaged"):
        fetch(str(copy), tmp_path / "out")
    data = json.loads((copy / "release.json").read_text())
    data["scenes"][0]["id"] = "../../elsewhere"
    (copy / "release.json").write_text(json.dumps(data))
    with pytest.raises(UserError, match="at scenes/0/id"):
        fetch(str(copy), tmp_path / "out")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"path": "manifest.json"', '"path": "notes.json"', "expected manifest.json of pattern-0, found none"),
        ('"path": "scene.json"', '"path": "README.md"', "expected distinct files, found one twice"),
        ('"path": "scene.json"', '"path": "../scene.json"', "at files/[0-9]+/path: '../scene.json' does not match"),
        ('"path": "scene.json"', '"path": "/scene.json"', "at files/[0-9]+/path: '/scene.json' does not match"),
        ('"camera": "cam_00"', '"camera": "../cam"', "at files/[0-9]+/camera"),
    ],
)
def test_a_hostile_index_is_refused(old: str, new: str, words: str, release_folder: Path, tmp_path: Path) -> None:
    """Its hash is the one that release.json has: whoever made it made both."""
    copy = Path(shutil.copytree(release_folder, tmp_path / "copy"))
    path = sorted(copy.glob("shards/*/*.json"))[0]
    before = sha256_file(path)
    path.write_text(path.read_text().replace(old, new, 1))
    top = copy / "release.json"
    top.write_text(top.read_text().replace(before, sha256_file(path)))
    with pytest.raises(UserError, match=words):
        fetch(str(copy), tmp_path / "out")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["copy", "out"]


def test_a_pinned_release(release_folder: Path, release: object) -> None:
    source = Source(str(release_folder))
    assert open_release(source, release.sha256) == release  # type: ignore[attr-defined]
    with pytest.raises(UserError, match=f"expected sha256 {'0' * 64}, found"):
        open_release(source, "0" * 64)


class TestSelection:
    def test_parts_of_one_camera(self, release_folder: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
        with serve(release_folder) as (address, seen):
            chosen = Selection(("pattern-1",), ("cam_02",), ("spikes",))
            report = fetch(address, tmp_path, chosen)
        got = tree(tmp_path)
        assert got == {name: whole[name] for name in got}
        top = {name for name in whole if name.startswith("pattern-1/") and name.count("/") == 1}
        assert set(got) == {*top, "pattern-1/spikes/cam_02.dat"}
        assert report.fetched == total(got)
        assert len(seen.asked()) == 2
        fetch(str(release_folder), tmp_path, Selection(("pattern-1",)))
        assert tree(tmp_path) == {n: d for n, d in whole.items() if n.startswith("pattern-1/")}, "the rest comes later"

    @pytest.mark.parametrize("window", [(0.0, 20.0), (100.0, 120.0), (437.55, 457.55), (990.0, 1000.0)])
    def test_a_cameras_window_in_one_request(
        self, window: tuple[float, float], release_folder: Path, scene_folders: tuple[Path, ...], tmp_path: Path
    ) -> None:
        with serve(release_folder) as (address, seen):
            report = fetch(address, tmp_path, Selection(("pattern-0",), ("cam_01",), (), window))
        assert len(seen.asked()) == 1
        (stream,) = open_stream_folder(report.folders[0]).values()
        first, stop = round(window[0] * 20), round(window[1] * 20)
        assert np.array_equal(stream.packed, open_scene(scene_folders[0]).stream("cam_01").packed[first:stop])
        assert report.fetched <= 2 * BLOCK
        facts = json.loads((report.folders[0] / "stream.json").read_text())["excerpt"]
        assert (facts["scene"], facts["first_tick"], facts["n_ticks"]) == ("pattern-0", first, stop - first)
        assert not list(tmp_path.rglob(".*.part"))
        with serve(release_folder) as (address, seen):
            fetch(address, tmp_path, Selection(("pattern-0",), ("cam_01",), (), window))
        assert seen.asked() == [], "it is there"

    def test_a_window_goes_on_with_the_cameras_that_are_missing(self, release_folder: Path, tmp_path: Path) -> None:
        chosen = Selection(("pattern-0",), ("cam_00", "cam_02"), (), (100.0, 120.0))
        started = tmp_path / "pattern-0-100-120ms/.download.json"

        def begin(other: int = 0) -> int:
            """Fetch one camera, in a download that then fails; return how many another one asks for."""
            with serve(release_folder, Behaviour(failures=[0, *[500] * 8])) as (address, _), pytest.raises(UserError):
                fetch(address, tmp_path, chosen, 1)
            assert len(list(started.parent.glob("*.dat"))) == 1
            edit_json(started, lambda facts: facts["excerpt"].update(first_tick=facts["excerpt"]["first_tick"] + other))
            with serve(release_folder) as (address, seen):
                fetch(address, tmp_path, chosen)
            assert len(open_stream_folder(started.parent)) == 2 and not started.exists()
            shutil.rmtree(started.parent)
            return len(seen.asked())

        assert begin() == 1
        assert begin(other=1) == 2, "the one that is there is of other ticks"

    def test_what_the_release_has_not(self, release_folder: Path, tmp_path: Path) -> None:
        for chosen, words in (
            (Selection(("car",)), "--scenes of release .*: expected one of pattern-0, pattern-1"),
            (Selection((), ("cam_77",)), "--cameras of release .*: expected one of cam_00"),
            (Selection((), (), ("sound",)), "--parts of release .*: expected one of calibration, description, images"),
            (Selection((), (), (), (1000.0, 1001.0)), "--window-ms: expected milliseconds from 0 to 1000"),
            (Selection((), (), ("spikes",), (0.0, 1.0)), "--window-ms: expected no --parts beside it"),
        ):
            with pytest.raises(UserError, match=words):
                fetch(str(release_folder), tmp_path / "out", chosen)
        fetch(str(release_folder), tmp_path, Selection(("pattern-0",), (), (), (990.0, 2000.0)))


class TestWhatIsThere:
    def test_damaged_blocks_are_mended(self, release_folder: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
        fetch(str(release_folder), tmp_path)
        long, short = tmp_path / "pattern-0/spikes/cam_00.dat", tmp_path / "pattern-1/scene.json"
        flip_bit(long, BLOCK + 7)
        long.write_bytes(long.read_bytes() + b"more")
        short.write_bytes(b"{}")
        report = fetch(str(release_folder), tmp_path)
        assert tree(tmp_path) == whole
        assert report.fetched == BLOCK + len(whole["pattern-1/scene.json"])

    def test_other_scenes_are_not_overwritten(self, release_folder: Path, tmp_path: Path) -> None:
        (tmp_path / "pattern-0").mkdir()
        for name in ("notes.txt", "manifest.json"):
            (tmp_path / "pattern-0" / name).write_text("{}")
            with pytest.raises(UserError, match="pattern-0: expected this version of the scene, or no folder"):
                fetch(str(release_folder), tmp_path)

    def test_a_foreign_part_does_no_harm(self, release_folder: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
        with serve(release_folder, Behaviour(failures=[403])) as (address, _), pytest.raises(UserError):
            fetch(address, tmp_path, workers=1)
        part = tmp_path / "pattern-0/spikes/.cam_00.dat.part"
        part.parent.mkdir(exist_ok=True)
        part.write_bytes(bytes(5 * BLOCK))
        fetch(str(release_folder), tmp_path)
        assert tree(tmp_path) == whole
        part.write_bytes(bytes(100))  # beside a file that is whole
        fetch(str(release_folder), tmp_path)
        assert tree(tmp_path) == whole

    @pytest.mark.parametrize("damage", [lambda path: flip_bit(path, 7), lambda path: os.truncate(path, 100)])
    def test_a_damaged_window_is_mended(
        self, damage: Callable[[Path], None], release_folder: Path, tmp_path: Path
    ) -> None:
        chosen = Selection(("pattern-0",), ("cam_00", "cam_02"), (), (100.0, 120.0))
        (folder,) = fetch(str(release_folder), tmp_path, chosen).folders
        whole = tree(folder)
        damage(folder / "cam_02.dat")
        report = fetch(str(release_folder), tmp_path, chosen)
        assert tree(folder) == whole and 0 < report.fetched <= 2 * BLOCK

    def test_damage_of_a_camera_that_is_not_asked_for_is_seen_later(self, release_folder: Path, tmp_path: Path) -> None:
        first, second = (Selection(("pattern-0",), (camera,), (), (100.0, 120.0)) for camera in ("cam_00", "cam_02"))
        (folder,) = fetch(str(release_folder), tmp_path, first).folders
        whole = tree(folder)["cam_00.dat"]
        flip_bit(folder / "cam_00.dat", 7)
        fetch(str(release_folder), tmp_path, second)
        assert fetch(str(release_folder), tmp_path, first).fetched > 0 and tree(folder)["cam_00.dat"] == whole


def check_goes_on(release_folder: Path, whole: dict[str, bytes], out: Path) -> None:
    """Check that what has its name is whole, and that another download does the rest alone."""
    finished = {name: data for name, data in tree(out).items() if not name.rpartition("/")[2].startswith(".")}
    assert finished == {name: whole[name] for name in finished}
    report = fetch(str(release_folder), out)
    assert tree(out) == whole
    assert report.fetched < total(whole), "it went on where it was"


class TestDisk:
    def test_room_is_sought_first(self, release_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        usage = shutil.disk_usage(tmp_path)._replace(free=1_000_000)
        monkeypatch.setattr(scenes_module.shutil, "disk_usage", lambda path: usage)
        with serve(release_folder) as (address, seen):
            with pytest.raises(UserError, match=r"expected 1?\d\.\d MB of free disk space, found 1.0 MB; free some"):
                fetch(address, tmp_path)
            assert seen.asked() == []

    def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(
        self, release_folder: Path, whole: dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """Files end at 1.5 MB meanwhile, as on a disk that is full."""
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_500_000, limits[1]))
        try:
            assert main(["download", "all", "--from", str(release_folder), "--out", str(tmp_path)]) == 2
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        said = capsys.readouterr().err
        assert "expected room for the file, found file too large; free some disk space" in said
        assert len(said.strip().splitlines()) == 1
        assert not (tmp_path / "pattern-0/manifest.json").exists()
        check_goes_on(release_folder, whole, tmp_path)


def test_killed_downloads_go_on(release_folder: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    code = "import sys; from spike4dgs.cli import main; sys.exit(main(sys.argv[1:]))"
    with serve(release_folder, Behaviour(pause_s=0.01)) as (address, _):
        command = [sys.executable, "-c", code, "download", "all", "--from", address, "--out", str(tmp_path)]
        limit = time.monotonic() + 60
        running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        enough = 0.8 * (total(whole) - 3_000_000)
        while running.poll() is None and size_of(tmp_path) < enough and time.monotonic() < limit:
            time.sleep(0.005)
        running.send_signal(signal.SIGKILL)
        assert running.wait() == -9, "it was killed before its end"
    check_goes_on(release_folder, whole, tmp_path)


def size_of(root: Path) -> int:
    """Bytes of the files that are there just now."""
    found = 0
    for path in root.rglob("*"):
        with contextlib.suppress(OSError):  # it was renamed meanwhile
            found += path.stat().st_size if path.is_file() else 0
    return found


def test_two_downloads_do_not_share_a_folder(release_folder: Path, tmp_path: Path) -> None:
    from spike4dgs.benchmark.files import locked

    with locked(tmp_path / ".download.lock", tmp_path, "free"), pytest.raises(UserError, match="a run in progress"):
        fetch(str(release_folder), tmp_path)


def test_without_an_address_there_is_no_server(
    tmp_path: Path, release_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv(source_module.VARIABLE, raising=False)
    assert main(["download", "all", "--out", str(tmp_path)]) == 2
    assert "there is no public server yet: add --from ADDRESS" in capsys.readouterr().err
    monkeypatch.setenv(source_module.VARIABLE, str(release_folder))
    assert main(["download", "all", "--scenes", "pattern-1", "--parts", "images", "--out", str(tmp_path)]) == 0
