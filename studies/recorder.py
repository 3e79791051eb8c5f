"""`speed record`: paced emulated cameras into memory and to disk, with queued reads beside single reads.

To disk the figure is how many cameras every one of several runs sustains.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.errors import problem
from spike4dgs.generators.recorder.resources import real_time
from spike4dgs.studies.kit.timing import show_table
from spike4dgs.studies.recorder_runs import FRAME_BYTES, Load, Outcome, disk_rate, run

COLUMNS: dict[str, Callable[[Outcome], str]] = {  # heading -> text, of a clip in memory
    "cameras": lambda o: str(len(o.clip.cameras)),
    "frames/s kept": lambda o: f"{o.frames_per_s:.0f}",
    "ticks in gaps": lambda o: str(o.lost_ticks),
    "lost unseen, MB": lambda o: f"{o.unseen_bytes / 1e6:.1f}",
    "wrong frames": lambda o: str(o.wrong_frames),
    "no read in flight: mean, ms": lambda o: f"{np.mean([c.stats.idle_mean_ms for c in o.clip.cameras]):.3g}",
    "worst, ms": lambda o: f"{max(c.stats.idle_worst_ms for c in o.clip.cameras):.3g}",
    "cores busy": lambda o: f"{o.cpu:.2f}",
}
DISK_COLUMNS: dict[str, Callable[[Sequence[Outcome]], str]] = {  # of all runs with a number of cameras
    "frames/s to disk, least": lambda runs: f"{min(o.frames_per_s for o in runs):.0f}",
    "longest write, s": lambda runs: f"{max(o.longest_write_s for o in runs):.2f}",
    "fullest buffer, s": lambda runs: f"{max(o.fullest_s for o in runs):.2f}",
    "of, s": lambda runs: f"{runs[0].buffer_s:.2f}",
    "ticks in gaps": lambda runs: str(sum(o.lost_ticks for o in runs)),
    "unseen, MB": lambda runs: f"{sum(o.unseen_bytes for o in runs) / 1e6:.1f}",
    "fsync, ms": lambda runs: f"{max(o.flush_s for o in runs) * 1e3:.0f}",
    "waits for disk, s": lambda runs: f"{max(o.waited_s for o in runs):.2f}",
    "cores busy": lambda runs: f"{np.mean([o.cpu for o in runs]):.2f}",
    "of it emulator": lambda runs: f"{np.mean([o.emulator_cpu for o in runs]):.2f}",
}

_LEAST_S = 4.0  # length of a clip; in a shorter one a disk that is too slow does not show
# Of data, that may wait when the buffers are emptiest in the second half: the files' own hold 0.07 s. A disk that is
# slower than the cameras by a share x leaves x times half the clip, so 2.5 % show in 8 s.
_LEFT_S = 0.1


def record(
    *,
    cameras: int = 9,
    seconds: float = 0.5,
    fps: int = 20000,
    transfer_kib: int = 1024,
    transfers: int = 16,
    memory_kib: int = 64,
    disk_seconds: float = 8.0,
    runs: int = 3,
    buffer_s: float | None = None,
    disk: Path | None = None,
    csv: Path | None = None,
) -> int:
    """Measure how many emulated cameras this machine records, into memory and to disk, and how it reads them.

    Each camera sends 400x250 at 20 kHz by the clock, 250 MB/s, through the code for real cameras; the
    emulator's own copying runs on the same processor, and the bus costs no time. A camera without a read in flight
    keeps as much as its memory holds and loses the rest, as real ones do. Recordings to disk have one camera, then two,
    and so on, each number several times, until one run is not sustained: ticks are lost, or the buffer does not empty
    again in its second half. Each number is shown beside the rate at which the disk stores as many bytes in as many
    files without any camera.

    Args:
        cameras: Most cameras.
        seconds: Length of a clip in memory; 0: none.
        fps: Frames a second of a camera.
        transfer_kib: Size of a read.
        transfers: Reads in flight for each camera.
        memory_kib: Memory of a camera and its USB bridge.
        disk_seconds: Length of each recording to disk; 0: none.
        runs: Recordings to disk of each number of cameras.
        buffer_s: Seconds that may wait for the disk; as `record` chooses if left out.
        disk: Folder for them; a temporary one if left out.
        csv: Also write the tables here, and with -disk behind the name.
    """
    if cameras < 1:
        raise problem("--cameras", "1 or more", str(cameras), "correct it")
    load = Load(cameras, fps, transfer_kib << 10, transfers, memory_kib << 10, buffer_s)
    mb_s = load.fps * FRAME_BYTES / 1e6
    title = f"emulated cameras of {mb_s:g} MB/s, {load.transfers} reads of {transfer_kib} KiB, {os.cpu_count()} cores"
    if seconds:
        found = {"queued": run(load, seconds), "one at a time": run(replace(load, transfers=1), seconds)}
        rows = [[name, *(text(o) for text in COLUMNS.values())] for name, o in found.items()]
        show_table(f"into memory: {title}", ["reads", *COLUMNS], rows, csv)
    if disk_seconds:
        with tempfile.TemporaryDirectory(dir=disk) as folder:
            show_disk(title, load, disk_seconds, max(runs, 1), Path(folder), csv)
    return 0


def show_disk(title: str, load: Load, seconds: float, runs: int, folder: Path, csv: Path | None) -> None:
    """Record one camera to disk `runs` times, then two, and so on until a run is not sustained; print the table."""
    rows: list[list[str]] = []
    most, end = 0, ", and may more"
    for n in range(1, load.cameras + 1):
        some, outcomes, failed = replace(load, cameras=n), list[Outcome](), list[str]()
        for i in range(runs):
            outcomes.append(run(some, seconds, folder / "clip"))
            reason = not_sustained(some, outcomes[-1])
            failed += [reason] if reason else []
            print(f"{_cameras(n)}, run {i + 1} of {runs}: {reason or 'sustained'}", flush=True)
        with real_time():  # as the recordings
            alone = disk_rate(folder, n, seconds, some.bytes_per_s)
        texts = [text(outcomes) for text in DISK_COLUMNS.values()]
        rows.append([str(n), f"{runs - len(failed)} of {runs}", *texts, f"{alone / 1e6:.0f}"])
        if failed:
            end = f"; {n}: {runs - len(failed)} of {runs}, {failed[0]}"
            break
        most = n
    columns = ["cameras", "runs sustained", *DISK_COLUMNS, "disk alone, MB/s"]
    show_table(f"to disk: {title}", columns, rows, csv and csv.with_stem(f"{csv.stem}-disk"))
    cache, priority = "past" if outcomes[-1].direct else "through", "real-time" if outcomes[-1].urgent else "ordinary"
    print(f"runs of {seconds:g} s at {priority} priority; written {cache} the page cache")
    print(f"every run of {runs} sustained {_cameras(most)} to disk{end}")


def not_sustained(load: Load, outcome: Outcome) -> str | None:
    """Return why a recording to disk does not show that this machine keeps up with the cameras; None where it does."""
    seconds, left = outcome.clip.n_ticks / load.fps, left_s(load, outcome)
    if outcome.lost_ticks:
        return f"{outcome.lost_ticks} ticks in gaps"
    if outcome.unseen_bytes:
        return f"{outcome.unseen_bytes / 1e6:.1f} MB lost while no read was in flight"
    if outcome.wrong_frames:
        return "wrong frames"
    if seconds < _LEAST_S:
        return f"runs of {seconds:g} s are too short to tell; {_LEAST_S:g} s show it"
    if left > _LEFT_S:
        return f"at least {left:.2f} s of data always wait in the second half"
    return None


def left_s(load: Load, outcome: Outcome) -> float:
    """Return the seconds of data that wait when the buffers are emptiest, in the second half of a recording.

    A disk that keeps up has written all that a stall left behind by then, or later in that half.
    """
    late = outcome.backlog[len(outcome.backlog) // 2 :, 1]
    return float(late.min()) / load.bytes_per_s if len(late) else 0.0


def _cameras(n: int) -> str:
    return f"{n} camera{'s' * (n != 1)}"
