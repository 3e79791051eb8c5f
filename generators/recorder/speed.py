"""`speed record`: paced emulated cameras into memory and to disk, with queued reads beside single reads."""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.speed.timing import show_table
from spike4dgs.generators.recorder.speed_runs import FRAME_BYTES, Load, Outcome, disk_rate, run

COLUMNS = (
    "reads", "cameras", "MB/s sent", "frames/s kept", "ticks in gaps", "lost unseen, MB", "wrong frames",
    "no read in flight: mean, ms", "worst, ms", "cores busy",
)  # fmt: skip
DISK_COLUMNS = (
    "cameras", "frames/s to disk", "backlog, MB: most", "growth in a second", "ticks in gaps", "unseen, MB",
    "fsync, ms", "disk alone, MB/s", "cores busy", "of it emulator",
)  # fmt: skip

_TIMES = 3.0  # least length of a clip, in times that the buffers hold: a shorter one does not measure the disk
_GROWTH = 0.02  # of the data rate: a backlog that grows by less is steady, within the accuracy of a few seconds


def record(argv: Sequence[str] = ()) -> int:
    """Measure how many emulated cameras this machine records, into memory and to disk, and how it reads them.

    Each camera sends 400x250 at 20 kHz by the clock, 250 MB/s, through pyusb and the code for real cameras; the
    emulator's own copying runs on the same processor, and the bus costs no time. A camera without a read in flight
    keeps as much as its memory holds and loses the rest, as real ones do. Recordings to disk have one camera, then two,
    and so on, until one is not sustained: ticks are lost, or the backlog grows in the second half. Each is shown beside
    the rate at which the disk stores as many bytes in as many files without any camera.
    """
    p = argparse.ArgumentParser("spike4dgs speed record", description=record.__doc__)
    p.add_argument("--cameras", type=int, default=9)
    p.add_argument("--seconds", type=float, default=0.5, help="length of a clip in memory; 0: none")
    p.add_argument("--fps", type=int, default=20000)
    p.add_argument("--transfer-kib", type=int, default=1024, help="size of a read")
    p.add_argument("--transfers", type=int, default=16, help="reads in flight for each camera")
    p.add_argument("--memory-kib", type=int, default=64, help="memory of a camera and its USB bridge")
    p.add_argument("--disk-seconds", type=float, default=4.0, help="length of each recording to disk; 0: none")
    p.add_argument("--disk", type=Path, help="folder for them (default: a temporary one)")
    p.add_argument("--csv", type=Path, help="also write the tables here, that of the disk with -disk behind the name")
    a = p.parse_args(list(argv))
    load = Load(a.cameras, a.fps, a.transfer_kib << 10, a.transfers, a.memory_kib << 10)
    mb_s = load.fps * FRAME_BYTES / 1e6
    title = f"emulated cameras of {mb_s:g} MB/s, {load.transfers} reads of {a.transfer_kib} KiB, {os.cpu_count()} cores"
    if a.seconds:
        rows = [_memory_row(load, run(load, a.seconds, queued), queued) for queued in (True, False)]
        show_table(f"into memory: {title}", COLUMNS, rows, a.csv)
    if a.disk_seconds:
        csv = a.csv and a.csv.with_stem(f"{a.csv.stem}-disk")
        with tempfile.TemporaryDirectory(dir=a.disk) as folder:
            _show_disk(title, load, a.disk_seconds, Path(folder), csv)
    return 0


def _show_disk(title: str, load: Load, seconds: float, folder: Path, csv: Path | None) -> None:
    rows, most, why, direct = [], 0, None, True
    for n in range(1, load.cameras + 1):
        some = replace(load, cameras=n)
        outcome = run(some, seconds, True, folder / "clip")
        alone = disk_rate(folder, n, seconds, some.bytes_per_s)
        why, direct = not_sustained(some, outcome), outcome.direct
        rows.append(_disk_row(some, outcome, alone))
        if why:
            break
        most = n
    show_table(f"to disk: {title}", DISK_COLUMNS, rows, csv)
    print(f"clips of {seconds:g} s; rings and buffers hold {load.buffer_s:.2f} s of what the cameras send")
    print(f"written {'past' if direct else 'through'} the page cache")
    cameras = f"{most} camera{'s' * (most != 1)}"
    print(f"this machine sustains {cameras} to disk" + (f"; {most + 1}: {why}" if why else ", and may more"))


def not_sustained(load: Load, outcome: Outcome) -> str | None:
    """Return why a recording to disk does not show that the disk keeps up with the cameras; None where it does."""
    seconds = outcome.clip.n_ticks / load.fps
    if not outcome.clip.complete:
        return f"{sum(c.stats.lost_ticks for c in outcome.clip.cameras)} ticks in gaps"
    if outcome.unseen_bytes:
        return f"{outcome.unseen_bytes / 1e6:.1f} MB lost while no read was in flight"
    if outcome.wrong_frames:
        return "wrong frames"
    if seconds < _TIMES * load.buffer_s:
        return f"{seconds:g} s are too short for buffers of {load.buffer_s:.2f} s"
    if growth(outcome) > _GROWTH * load.bytes_per_s:
        return f"the backlog grows by {growth(outcome) / 1e6:.0f} MB/s"
    return None


def growth(outcome: Outcome) -> float:
    """Return the growth of the backlog in a recording's second half, bytes a second: the slope of a fitted line."""
    late = outcome.backlog[len(outcome.backlog) // 2 :]
    return float(np.polyfit(late[:, 0], late[:, 1], 1)[0]) if len(late) > 1 else 0.0


def _kept_per_s(outcome: Outcome) -> float:
    clip = outcome.clip
    lost = sum(c.stats.lost_ticks for c in clip.cameras)
    return (clip.n_ticks * len(clip.cameras) - lost) / outcome.seconds


def _memory_row(load: Load, outcome: Outcome, queued: bool) -> list[str]:
    stats = [c.stats for c in outcome.clip.cameras]
    return [
        f"{load.transfers} queued" if queued else "one at a time",
        str(load.cameras),
        f"{load.bytes_per_s / 1e6:.0f}",
        f"{_kept_per_s(outcome):.0f}",
        str(sum(s.lost_ticks for s in stats)),
        f"{outcome.unseen_bytes / 1e6:.1f}",
        str(outcome.wrong_frames),
        f"{np.mean([s.idle_mean_ms for s in stats]):.3g}",
        f"{max(s.idle_worst_ms for s in stats):.3g}",
        f"{outcome.cpu:.2f}",
    ]


def _disk_row(load: Load, outcome: Outcome, alone: float) -> list[str]:
    return [
        str(load.cameras),
        f"{_kept_per_s(outcome):.0f}",
        f"{outcome.backlog[:, 1].max(initial=0.0) / 1e6:.0f}",
        f"{growth(outcome) / 1e6:+.0f}",
        str(sum(c.stats.lost_ticks for c in outcome.clip.cameras)),
        f"{outcome.unseen_bytes / 1e6:.1f}",
        f"{outcome.flush_s * 1e3:.0f}",
        f"{alone / 1e6:.0f}",
        f"{outcome.cpu:.2f}",
        f"{outcome.emulator_cpu:.2f}",
    ]
