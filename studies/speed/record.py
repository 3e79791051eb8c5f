"""`speed record`: paced emulated cameras into memory and to disk, with queued reads beside single reads."""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spike4dgs.studies.speed.record_disk import show_disk
from spike4dgs.studies.speed.record_runs import FRAME_BYTES, Load, Outcome, run
from spike4dgs.studies.speed.timing import show_table

COLUMNS = (
    "reads", "cameras", "MB/s sent", "frames/s kept", "ticks in gaps", "lost unseen, MB", "wrong frames",
    "no read in flight: mean, ms", "worst, ms", "cores busy",
)  # fmt: skip


def record(argv: Sequence[str] = ()) -> int:
    """Measure how many emulated cameras this machine records, into memory and to disk, and how it reads them.

    Each camera sends 400x250 at 20 kHz by the clock, 250 MB/s, through pyusb and the code for real cameras; the
    emulator's own copying runs on the same processor, and the bus costs no time. A camera without a read in flight
    keeps as much as its memory holds and loses the rest, as real ones do. Recordings to disk have one camera, then two,
    and so on, each number several times, until one run is not sustained: ticks are lost, or the buffer does not empty
    again in its second half. Each number is shown beside the rate at which the disk stores as many bytes in as many
    files without any camera.
    """
    p = argparse.ArgumentParser("spike4dgs speed record", description=record.__doc__)
    p.add_argument("--cameras", type=int, default=9)
    p.add_argument("--seconds", type=float, default=0.5, help="length of a clip in memory; 0: none")
    p.add_argument("--fps", type=int, default=20000)
    p.add_argument("--transfer-kib", type=int, default=1024, help="size of a read")
    p.add_argument("--transfers", type=int, default=16, help="reads in flight for each camera")
    p.add_argument("--memory-kib", type=int, default=64, help="memory of a camera and its USB bridge")
    p.add_argument("--disk-seconds", type=float, default=8.0, help="length of each recording to disk; 0: none")
    p.add_argument("--runs", type=int, default=3, help="recordings to disk of each number of cameras")
    p.add_argument("--buffer-s", type=float, help="seconds that may wait for the disk (default: as `record` chooses)")
    p.add_argument("--disk", type=Path, help="folder for them (default: a temporary one)")
    p.add_argument("--csv", type=Path, help="also write the tables here, and with -disk and -disk-runs behind the name")
    a = p.parse_args(list(argv))
    load = Load(a.cameras, a.fps, a.transfer_kib << 10, a.transfers, a.memory_kib << 10, a.buffer_s)
    mb_s = load.fps * FRAME_BYTES / 1e6
    title = f"emulated cameras of {mb_s:g} MB/s, {load.transfers} reads of {a.transfer_kib} KiB, {os.cpu_count()} cores"
    if a.seconds:
        rows = [_memory_row(load, run(load, a.seconds, queued), queued) for queued in (True, False)]
        show_table(f"into memory: {title}", COLUMNS, rows, a.csv)
    if a.disk_seconds:
        with tempfile.TemporaryDirectory(dir=a.disk) as folder:
            show_disk(title, load, a.disk_seconds, max(a.runs, 1), Path(folder), a.csv)
    return 0


def _memory_row(load: Load, outcome: Outcome, queued: bool) -> list[str]:
    stats = [c.stats for c in outcome.clip.cameras]
    return [
        f"{load.transfers} queued" if queued else "one at a time",
        str(load.cameras),
        f"{load.bytes_per_s / 1e6:.0f}",
        f"{outcome.frames_per_s:.0f}",
        str(outcome.lost_ticks),
        f"{outcome.unseen_bytes / 1e6:.1f}",
        str(outcome.wrong_frames),
        f"{np.mean([s.idle_mean_ms for s in stats]):.3g}",
        f"{max(s.idle_worst_ms for s in stats):.3g}",
        f"{outcome.cpu:.2f}",
    ]
