"""`speed record`: its figures are true, and a disk that falls behind is not called sufficient."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spike4dgs.generators.recorder import speed_runs
from spike4dgs.generators.recorder.files import disk
from spike4dgs.generators.recorder.files.clip_files import StreamFiles
from spike4dgs.generators.recorder.frames.layouts import UInt8
from spike4dgs.generators.recorder.speed import COLUMNS, DISK_COLUMNS, growth, not_sustained, record
from spike4dgs.generators.recorder.speed_runs import FRAME_BYTES, Load, Outcome, disk_rate, run

SLOW = Load(cameras=2, fps=400, transfer_bytes=16384, transfers=16, memory_bytes=1 << 24, ring_seconds=5.0)


def test_a_clip_in_memory_has_every_frame() -> None:
    outcome = run(SLOW, 0.1, queued=True)
    assert outcome.clip.complete and outcome.unseen_bytes == 0 and outcome.wrong_frames == 0
    assert outcome.clip.n_ticks == 40 and outcome.seconds > 0.08
    assert 0 < outcome.emulator_cpu < outcome.cpu < 16


def test_a_recording_to_disk_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outcome = run(SLOW, 0.5, True, tmp_path / "clip")
    assert outcome.clip.complete and (outcome.clip.n_ticks, outcome.wrong_frames) == (200, 0)
    assert outcome.flush_s > 0 and outcome.seconds > 0.45 + outcome.flush_s
    assert len(outcome.backlog) >= 1 and outcome.backlog[-1, 0] < outcome.seconds
    assert not (tmp_path / "clip").exists()

    write = StreamFiles.write

    def damage(files: StreamFiles, camera: str, first_tick: int, frames: UInt8) -> None:
        write(files, camera, first_tick, frames ^ 1 if camera == "cam_01" and first_tick < 100 else frames)

    monkeypatch.setattr(StreamFiles, "write", damage)
    assert 100 <= run(SLOW, 0.5, True, tmp_path / "clip").wrong_frames < 120


def outcome(backlog: list[float], **changes: Any) -> Outcome:
    """Return the outcome of four seconds of one camera, with samples of its backlog in bytes."""
    clip: Any = SimpleNamespace(n_ticks=80_000, complete=True, cameras=[])
    at = np.linspace(0.0, 4.0, len(backlog))
    made = Outcome(clip, 4.0, 0, 0, 0.01, np.stack([at, np.array(backlog)], axis=1), 0.5, 0.2, True)
    return replace(made, **changes)


def test_a_sustained_recording_keeps_up_to_the_end() -> None:
    load = Load(1, 20_000, 1 << 20, 16, 65536)
    assert load.bytes_per_s == 20_000 * FRAME_BYTES and load.buffer_s == pytest.approx(0.5 + 16 * 1.048576 / 250)
    steady = outcome([0, 80e6, *(20e6 + 3e6 * (i % 2) for i in range(20))])
    assert not_sustained(load, steady) is None
    assert growth(outcome([0, 0, 0, 0, 10e6, 20e6, 30e6, 40e6])) == pytest.approx(10e6 / (4.0 / 7))
    filling = outcome([0, *(6e6 * i for i in range(20))])  # of which the buffers lose no byte in four seconds
    assert str(not_sustained(load, filling)).startswith("the backlog grows by 30 MB/s")
    lost: Any = SimpleNamespace(
        n_ticks=80_000, complete=False, cameras=[SimpleNamespace(stats=SimpleNamespace(lost_ticks=7))]
    )
    assert not_sustained(load, replace(steady, clip=lost)) == "7 ticks in gaps"
    assert "no read was in flight" in str(not_sustained(load, replace(steady, unseen_bytes=10**6)))
    assert not_sustained(load, replace(steady, wrong_frames=1)) == "wrong frames"
    assert "too short" in str(not_sustained(replace(load, ring_seconds=2.0), steady))


def test_the_disk_alone_writes_as_many_bytes_and_keeps_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed_runs, "BUFFER_BYTES", 1 << 16)
    written = []
    write = disk.os.pwrite
    monkeypatch.setattr(disk.os, "pwrite", lambda fd, data, at: written.append(len(data)) or write(fd, data, at))
    assert disk_rate(tmp_path, 3, 0.5, 3 << 20) > 0
    assert sum(written) == 3 << 19 and not list(tmp_path.iterdir())


def test_the_command_writes_both_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = "--cameras 1 --fps 400 --seconds 0.05 --transfer-kib 16 --memory-kib 16384 --disk-seconds 0.05 --disk"
    assert record([*arguments.split(), str(tmp_path), "--csv", str(tmp_path / "t.csv")]) == 0
    lines = list(csv.reader((tmp_path / "t.csv").read_text().splitlines()))
    assert lines[0] == list(COLUMNS)
    assert [line[:2] for line in lines[1:]] == [["16 queued", "1"], ["one at a time", "1"]]
    lines = list(csv.reader((tmp_path / "t-disk.csv").read_text().splitlines()))
    assert lines[0] == list(DISK_COLUMNS) and [line[0] for line in lines[1:]] == ["1"]
    shown = capsys.readouterr().out
    assert "this machine sustains 0 cameras to disk; 1: 0.05 s are too short for buffers of 3.86 s" in shown
    assert sorted(p.name for p in tmp_path.iterdir()) == ["t-disk.csv", "t.csv"]
