"""Files past the page cache: any pieces at any offsets become the same bytes, and failed writes are reported."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recorder_rig import FRAME, source_scene

from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.cli import main
from spike4dgs.generators.recorder import disk as disk
from spike4dgs.generators.recorder.disk import Buffers, DiskFile

BLOCK = 4096


def noise(n: int) -> np.ndarray:
    return np.random.default_rng(n).integers(1, 256, n, dtype=np.uint8)


def no_direct(monkeypatch: pytest.MonkeyPatch) -> None:
    """Imitate a file system without O_DIRECT."""
    system = os.open

    def refuse(path: Path, flags: int, mode: int = 0o777) -> int:
        if flags & os.O_DIRECT:
            raise OSError(errno.EINVAL, "invalid argument")
        return system(path, flags, mode)

    monkeypatch.setattr(disk.os, "open", refuse)


@pytest.mark.parametrize("direct", [True, False])
@settings(max_examples=40, deadline=None)
@given(
    pieces=st.lists(st.tuples(st.sampled_from([0, 0, 1, 100, 4096, 9000, 30000]), st.integers(0, 20000)), max_size=12),
    size=st.sampled_from([1, 2, 5]),
    tail=st.integers(1, 5000),
)
def test_pieces_become_the_file_that_holds_them(
    tmp_path_factory: pytest.TempPathFactory, direct: bool, pieces: list[tuple[int, int]], size: int, tail: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(disk, "BUFFER_BYTES", size * BLOCK)
        if not direct:
            no_direct(patch)
        expected = np.zeros(sum(map(sum, pieces)) + tail, np.uint8)
        buffers = Buffers(1, len(expected))
        path = tmp_path_factory.mktemp("disk") / "file"
        file = DiskFile(path, len(expected), buffers)
        at = 0
        for skip, n in pieces:
            expected[at + skip : at + skip + n] = noise(n)
            file.write(at + skip, noise(n))
            at += skip + n
        file.flush()
        assert file.error is None and buffers.waiting == 0 and (direct or not file.direct)
        file.close(len(expected))
    assert path.read_bytes() == expected.tobytes()
    path.unlink()


def test_bytes_come_in_the_order_of_the_file(tmp_path: Path) -> None:
    file = DiskFile(tmp_path / "file", 100, Buffers(1, 100))
    file.write(10, noise(20))
    with pytest.raises(ValueError, match="byte 29 is to be written after byte 30"):
        file.write(29, noise(1))
    file.close(50)
    assert (tmp_path / "file").read_bytes() == bytes(10) + noise(20).tobytes() + bytes(20)


@pytest.mark.parametrize("refused", [0, 3])
def test_a_write_that_is_not_aligned_enough_goes_through_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: int
) -> None:
    write, calls, synced = os.pwrite, iter(range(99)), []
    sync = os.fdatasync

    def some(fd: int, data: memoryview, at: int) -> int:
        if next(calls) == refused:
            raise OSError(errno.EINVAL, "invalid argument")
        return write(fd, data[:BLOCK], at)  # and never all of it

    monkeypatch.setattr(disk, "BUFFER_BYTES", 2 * BLOCK)
    monkeypatch.setattr(disk.os, "pwrite", some)
    monkeypatch.setattr(disk.os, "fdatasync", lambda fd: synced.append(sync(fd)))
    file = DiskFile(tmp_path / "file", 50000, Buffers(1, 50000))
    file.write(0, noise(50000))
    file.flush()
    assert (file.direct, file.error, file.written) == (False, None, 13 * BLOCK)
    assert len(synced) == 7 - refused // 2, "each buffer is forced out"
    file.close(50000)
    assert (tmp_path / "file").read_bytes() == noise(50000).tobytes()


def fail_at(monkeypatch: pytest.MonkeyPatch, offset: int, name: str = "", error: int = errno.ENOSPC) -> None:
    """Imitate a disk that stores no byte from `offset` on in files whose path contains `name`."""
    write = os.pwrite

    def take(fd: int, data: memoryview, at: int) -> int:
        if name in os.readlink(f"/proc/self/fd/{fd}"):
            data = data[: max(offset - at, 0)]
            if not len(data):
                raise OSError(error, os.strerror(error))
        return write(fd, data, at)

    monkeypatch.setattr(disk.os, "pwrite", take)


def test_an_error_is_kept_and_earlier_bytes_are_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk, "BUFFER_BYTES", 2 * BLOCK)
    fail_at(monkeypatch, 5 * BLOCK)
    buffers = Buffers(1, 50000)
    file = DiskFile(tmp_path / "file", 50000, buffers)
    for at in range(0, 50000, 1000):  # continues without waiting for a buffer that is never returned
        file.write(at, noise(1000))
    file.flush()
    assert file.error is not None and file.error.errno == errno.ENOSPC and file.written == 5 * BLOCK
    assert buffers.waiting in (0, 2 * BLOCK)
    file.blank(20000)
    file.close(50000)
    expected = np.tile(noise(1000), 50)
    expected[20000:] = 0
    assert (tmp_path / "file").read_bytes() == expected.tobytes()


def test_a_file_without_room_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(fd: int, at: int, n: int) -> None:
        raise OSError(errno.ENOSPC, "no space left on device")

    monkeypatch.setattr(disk.os, "posix_fallocate", full)
    with pytest.raises(OSError, match="no space left"):
        DiskFile(tmp_path / "file", 100, Buffers(1, 100))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("error", [errno.EINVAL, errno.EOPNOTSUPP])
def test_space_that_cannot_be_reserved_past_the_cache_is_reserved_through_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: int
) -> None:
    reserve = os.posix_fallocate

    def aligned(fd: int, at: int, n: int) -> None:
        if fcntl.fcntl(fd, fcntl.F_GETFL) & os.O_DIRECT:
            raise OSError(error, os.strerror(error))
        reserve(fd, at, n)

    monkeypatch.setattr(disk.os, "posix_fallocate", aligned)
    file = DiskFile(tmp_path / "file", 50000, Buffers(1, 50000))
    assert not file.direct and (tmp_path / "file").stat().st_size == 50000
    file.write(0, noise(50000))
    file.close(50000)
    assert (tmp_path / "file").read_bytes() == noise(50000).tobytes()


# ---------------------------------------------------------------- recordings

TICKS = 2000  # 0.1 s, 240 kB a camera


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return source_scene(tmp_path_factory.mktemp("source") / "scene", cameras=2, ticks=TICKS).root


def packed(scene: Path, camera: str) -> np.ndarray:
    return open_scene(scene, allow_gaps=True).stream(camera).packed


def check_end(out: Path, source: Path, camera: str, stop: int) -> None:
    """Check that the recording has the camera's ticks up to `stop`, and after them a gap and zeros."""
    recorded = open_scene(out, allow_gaps=True)
    n = recorded.n_ticks
    gaps = [(g.first_tick, g.stop_tick, g.reason) for g in recorded.gaps if g.camera == camera]
    assert gaps == ([(stop, n, "disk")] if stop < n else [])
    expected = np.resize(packed(source, camera), (n, FRAME)).copy()
    expected[stop:] = 0
    np.testing.assert_array_equal(packed(out, camera), expected)


@pytest.mark.parametrize("error", [errno.EIO, errno.EDQUOT])
def test_a_camera_whose_file_fails_ends_alone(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: int
) -> None:
    monkeypatch.setattr(disk, "BUFFER_BYTES", 8 * BLOCK)
    fail_at(monkeypatch, 100_000, "cam_01", error)
    assert main(["record", "--emulate", str(source), "--out", str(tmp_path / "clip"), "--continuous"]) == 3
    check_end(tmp_path / "clip", source, "cam_00", TICKS)
    check_end(tmp_path / "clip", source, "cam_01", 100_000 // FRAME)
    shown = capsys.readouterr()
    found = os.strerror(error).lower()
    assert f"cam_01.dat: expected {'a disk that writes' if error == errno.EIO else 'room for the file'}" in shown.err
    assert f"found {found}" in shown.err and "kept" in shown.err
    assert f"gap: cam_01 from tick {100_000 // FRAME}, {TICKS - 100_000 // FRAME} ticks (disk)" in shown.out
    cameras = open_scene(tmp_path / "clip", allow_gaps=True).meta["source"]["cameras"]
    assert [cameras[c]["end"] for c in ("cam_00", "cam_01")] == ["ok", "disk"]
    assert cameras["cam_01"]["lost_ticks"] == TICKS - 100_000 // FRAME


def test_a_recording_ends_when_no_file_accepts_data(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(disk, "BUFFER_BYTES", 8 * BLOCK)
    fail_at(monkeypatch, 24 * BLOCK)
    out = tmp_path / "clip"
    assert main(["record", "--emulate", str(source), "--out", str(out), "--continuous", "--seconds", "60"]) == 3
    n = open_scene(out, allow_gaps=True).n_ticks
    assert 24 * BLOCK // FRAME < n < 60 * 20000
    for camera in ("cam_00", "cam_01"):
        check_end(out, source, camera, 24 * BLOCK // FRAME)
    assert "ended early" in capsys.readouterr().out


def test_a_disk_without_room_is_an_error_and_leaves_no_files(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fail_at(monkeypatch, 0)
    assert main(["record", "--emulate", str(source), "--out", str(tmp_path / "clip"), "--continuous"]) == 2
    assert "cam_00.dat: expected room for the file, found no space left" in capsys.readouterr().err
    assert not (tmp_path / "clip").exists()


def test_data_that_cannot_be_synchronised_are_not_claimed(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sync = os.fsync

    def fail(fd: int) -> None:
        if "cam_01.dat" in os.readlink(f"/proc/self/fd/{fd}"):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        sync(fd)

    monkeypatch.setattr(disk.os, "fsync", fail)
    assert main(["record", "--emulate", str(source), "--out", str(tmp_path / "clip"), "--continuous"]) == 3
    gaps = open_scene(tmp_path / "clip", allow_gaps=True).gaps
    assert [(g.camera, g.first_tick, g.ticks, g.reason) for g in gaps] == [("cam_01", 0, TICKS, "disk")]


_LIMITED = """
import resource, sys
from spike4dgs.cli import main
from spike4dgs.generators.recorder import record

def capture(*arguments, **options):  # the files are as long as the clip by now
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
    return captured(*arguments, **options)

captured, record.capture = record.capture, capture
sys.exit(main(sys.argv[1:]))
"""


def test_a_limit_of_the_system_is_found_by_the_byte(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "clip"
    command = [sys.executable, "-c", _LIMITED, "record", "--emulate", str(source), "--out", str(out), "--continuous"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 3, done.stderr
    assert done.stderr.count("expected room for the file, found file too large") == 2
    kept = {(stop := g.first_tick, g.camera) for g in open_scene(out, allow_gaps=True).gaps}
    assert len(kept) == 2
    for stop, camera in kept:
        assert stop == 100_000 // FRAME
        check_end(out, source, camera, stop)


def test_the_streams_of_a_killed_recording_are_named(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "clip"
    (out / "spikes").mkdir(parents=True)
    (out / "spikes" / ".cam_01.dat.part").write_bytes(b"half")
    assert main(["record", "--emulate", str(source), "--out", str(out)]) == 2
    shown = capsys.readouterr().err.strip()
    assert ".cam_01.dat.part: expected a folder without a recording, found the streams of a recording that" in shown
    assert shown.endswith(f"choose another --out, or remove {out}")
