"""`speed record`: its figures are true, and a disk that falls behind is not called sufficient."""

import csv
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.cli import main
from spike4dgs.generators.recorder import disk as disk
from spike4dgs.generators.recorder.clip_files import StreamFiles
from spike4dgs.studies import recorder_runs as speed_runs
from spike4dgs.studies.recorder import COLUMNS, DISK_COLUMNS, left_s, not_sustained
from spike4dgs.studies.recorder_runs import FRAME_BYTES, Load, Outcome, disk_rate, run

SLOW = Load(cameras=2, fps=400, transfer_bytes=16384, transfers=16, memory_bytes=1 << 24, buffer_s=5.0)


def test_a_clip_in_memory_has_every_frame() -> None:
    outcome = run(SLOW, 0.1)
    assert outcome.clip.complete and outcome.unseen_bytes == 0 and outcome.wrong_frames == 0
    assert outcome.clip.n_ticks == 40 and outcome.seconds > 0.08
    assert 0 < outcome.emulator_cpu < outcome.cpu < 16


def test_a_recording_to_disk_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outcome = run(SLOW, 0.5, tmp_path / "clip")
    assert outcome.clip.complete and (outcome.clip.n_ticks, outcome.wrong_frames) == (200, 0)
    assert outcome.flush_s > 0 and outcome.seconds > 0.45 + outcome.flush_s
    assert len(outcome.backlog) >= 1 and outcome.backlog[-1, 0] < outcome.seconds
    assert 0 < outcome.longest_write_s < outcome.seconds and outcome.buffer_s == 5.0
    assert 0 <= outcome.fullest_s < 0.5 and outcome.waited_s < outcome.seconds
    assert not (tmp_path / "clip").exists()

    write = StreamFiles.write

    def damage(files: StreamFiles, camera: str, first_tick: int, frames: UInt8) -> None:
        write(files, camera, first_tick, frames ^ 1 if camera == "cam_01" and first_tick < 100 else frames)

    monkeypatch.setattr(StreamFiles, "write", damage)
    assert 100 <= run(SLOW, 0.5, tmp_path / "clip").wrong_frames < 120


LOAD = Load(1, 20_000, 1 << 20, 16, 65536)


def outcome(backlog_s: list[float], lost_ticks: int = 0, **changes: Any) -> Outcome:
    """Return the outcome of eight seconds of one camera, with samples of its backlog in seconds of data."""
    stats = SimpleNamespace(lost_ticks=lost_ticks, backlog=30, slots=120)
    clip: Any = SimpleNamespace(n_ticks=160_000, cameras=[SimpleNamespace(stats=stats)])
    backlog = np.stack([np.linspace(0.0, 8.0, len(backlog_s)), np.array(backlog_s) * LOAD.bytes_per_s], axis=1)
    made = Outcome(clip, 8.0, 0, 0, 0.01, backlog, 4.0, 0.6, 0.5, 0.5, 0.2, True, True)
    return replace(made, **changes)


def test_a_sustained_recording_empties_its_buffer_again() -> None:
    assert LOAD.bytes_per_s == 20_000 * FRAME_BYTES
    steady = outcome([0.0, 0.3, *(0.02 + 0.01 * (i % 2) for i in range(40))])
    assert not_sustained(LOAD, steady) is None
    assert left_s(LOAD, steady) == pytest.approx(0.02)
    assert steady.fullest_s == 1.0 and steady.frames_per_s == 20_000.0
    stalled = outcome([0.02] * 25 + [0.5, 0.4, 0.3, 0.2, 0.1, *[0.02] * 10])
    assert not_sustained(LOAD, stalled) is None, "a stall that the buffer holds, and that the disk makes up for"
    slow = [0.03 * t for t in np.linspace(0.0, 8.0, 41)]  # a disk 3 % too slow, of which the buffers lose nothing
    assert left_s(LOAD, outcome(slow)) == pytest.approx(0.12)
    assert not_sustained(LOAD, outcome(slow)) == "at least 0.12 s of data always wait in the second half"


def test_what_is_lost_is_not_sustained() -> None:
    lost = outcome([0.0] * 40, lost_ticks=7)
    assert not_sustained(LOAD, lost) == "7 ticks in gaps"
    assert lost.frames_per_s == (160_000 - 7) / 8.0
    unseen = outcome([0.0] * 40, unseen_bytes=10**6)
    assert not_sustained(LOAD, unseen) == "1.0 MB lost while no read was in flight"
    assert not_sustained(LOAD, outcome([0.0] * 40, wrong_frames=1)) == "wrong frames"
    assert "too short to tell" in str(not_sustained(replace(LOAD, fps=50_000), outcome([0.0] * 40)))


def test_the_disk_alone_writes_as_many_bytes_and_keeps_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed_runs, "BUFFER_BYTES", 1 << 16)
    written = []
    write = disk.os.pwrite
    monkeypatch.setattr(disk.os, "pwrite", lambda fd, data, at: written.append(len(data)) or write(fd, data, at))
    assert disk_rate(tmp_path, 3, 0.5, 3 << 20) > 0
    assert sum(written) == 3 << 19 and not list(tmp_path.iterdir())


def test_the_command_writes_both_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = "--cameras 2 --fps 400 --seconds 0.05 --transfer-kib 16 --memory-kib 16384 --disk-seconds 0.05 --runs 2"
    assert main(["speed", "record", *arguments.split(), "--disk", str(tmp_path), "--csv", str(tmp_path / "t.csv")]) == 0
    lines = list(csv.reader((tmp_path / "t.csv").read_text().splitlines()))
    assert lines[0] == ["reads", *COLUMNS]
    assert [line[:2] for line in lines[1:]] == [["queued", "2"], ["one at a time", "2"]]
    lines = list(csv.reader((tmp_path / "t-disk.csv").read_text().splitlines()))
    assert lines[0] == ["cameras", "runs sustained", *DISK_COLUMNS, "disk alone, MB/s"]
    (row,) = (dict(zip(lines[0], line, strict=True)) for line in lines[1:])
    found = [row[c] for c in ("cameras", "runs sustained", "ticks in gaps", "unseen, MB")]
    assert found == ["1", "0 of 2", "0", "0.0"]
    shown = capsys.readouterr().out
    assert "1 camera, run 2 of 2: runs of 0.05 s are too short to tell" in shown
    assert "every run of 2 sustained 0 cameras to disk; 1: 0 of 2, runs of 0.05 s are too short" in shown
    assert sorted(p.name for p in tmp_path.iterdir()) == ["t-disk.csv", "t.csv"]
