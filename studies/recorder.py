"""`speed record`: paced emulated cameras into memory and to disk, with queued reads beside single reads.

To disk the figure is how many cameras every one of several runs sustains.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from spike4dgs.generators.recorder.resources import real_time
from spike4dgs.studies.kit.timing import show_table, write_csv
from spike4dgs.studies.recorder_runs import FRAME_BYTES, Load, Outcome, disk_rate, run

COLUMNS = (
    "reads", "cameras", "MB/s sent", "frames/s kept", "ticks in gaps", "lost unseen, MB", "wrong frames",
    "no read in flight: mean, ms", "worst, ms", "cores busy",
)  # fmt: skip
DISK_COLUMNS = (
    "cameras", "runs sustained", "frames/s to disk, least", "longest write, s", "fullest buffer, s",
    "still waiting, s", "ticks in gaps", "unseen, MB", "fsync, ms", "disk alone, MB/s", "cores busy", "of it emulator",
    "limit",
)  # fmt: skip
RUN_COLUMNS = (
    "cameras", "run", "result", "frames/s to disk", "longest write, s", "fullest buffer, s", "of, s",
    "still waiting, s", "ticks in gaps", "unseen, bytes", "wrong frames", "fsync, ms", "wait for disk, s",
    "longest time without a read, ms", "cores busy", "of it emulator",
)  # fmt: skip

DISK, PROCESSOR = "disk", "processor"

_LEAST_S = 4.0  # length of a clip; in a shorter one a disk that is too slow does not show
# Of data, that may wait when the buffers are emptiest in the second half: the files' own hold 0.07 s. A disk that is
# slower than the cameras by a share x leaves x times half the clip, so 2.5 % show in 8 s.
_LEFT_S = 0.1
_WAITS = 0.5  # share of a clip: a delivery that waits longer than this for the disk is limited by it


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
        csv: Also write the tables here, and with -disk and -disk-runs behind the name.
    """
    load = Load(cameras, fps, transfer_kib << 10, transfers, memory_kib << 10, buffer_s)
    mb_s = load.fps * FRAME_BYTES / 1e6
    title = f"emulated cameras of {mb_s:g} MB/s, {load.transfers} reads of {transfer_kib} KiB, {os.cpu_count()} cores"
    if seconds:
        rows = [_memory_row(some, run(some, seconds)) for some in (load, replace(load, transfers=1))]
        show_table(f"into memory: {title}", COLUMNS, rows, csv)
    if disk_seconds:
        with tempfile.TemporaryDirectory(dir=disk) as folder:
            show_disk(title, load, disk_seconds, max(runs, 1), Path(folder), csv)
    return 0


def _memory_row(load: Load, outcome: Outcome) -> list[str]:
    stats = [c.stats for c in outcome.clip.cameras]
    return [
        f"{load.transfers} queued" if load.transfers > 1 else "one at a time",
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


def show_disk(title: str, load: Load, seconds: float, runs: int, folder: Path, csv: Path | None) -> None:
    """Record one camera to disk `runs` times, then two, and so on until a run is not sustained; print the tables."""
    rows: list[list[str]] = []
    each: list[list[str]] = []
    every: list[Outcome] = []
    most, end = 0, ", and may more"
    for n in range(1, load.cameras + 1):
        some = replace(load, cameras=n)
        outcomes = []
        for i in range(runs):
            outcomes.append(run(some, seconds, folder / "clip"))
            each.append(_run_row(some, i + 1, outcomes[-1]))
            print(f"{_cameras(n)}, run {i + 1} of {runs}: {each[-1][2]}", flush=True)
        with real_time():  # as the recordings
            alone = disk_rate(folder, n, seconds, some.bytes_per_s)
        rows.append(_row(some, outcomes, alone))
        every += outcomes
        if failed := [reason for o in outcomes if (reason := not_sustained(some, o))]:
            end = f"; {n}: {runs - len(failed)} of {runs}, {failed[0]}"
            break
        most = n
    show_table(f"to disk: {title}", DISK_COLUMNS, rows, csv and csv.with_stem(f"{csv.stem}-disk"))
    if csv:
        runs_path = csv.with_stem(f"{csv.stem}-disk-runs")
        write_csv(runs_path, RUN_COLUMNS, each)
        print(f"written: {runs_path}")
    cache, priority = "past" if every[-1].direct else "through", "real-time" if every[-1].urgent else "ordinary"
    print(f"runs of {seconds:g} s at {priority} priority; written {cache} the page cache")
    print(_worst(every))
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


def limit(load: Load, outcome: Outcome) -> str | None:
    """Return what a run that is not sustained lacks: the disk or the processor; None where it lacks nothing.

    Bytes are lost unseen when a reading thread gets no processor in time. The buffer fills because the delivery waits
    for the disk, or because it gets no processor to copy frames.
    """
    if not_sustained(load, outcome) is None:
        return None
    waits = outcome.waited_s > _WAITS * outcome.seconds
    return DISK if waits and not outcome.unseen_bytes else PROCESSOR


def _row(load: Load, outcomes: Sequence[Outcome], alone: float) -> list[str]:
    good = sum(not_sustained(load, o) is None for o in outcomes)
    limits = sorted({found for o in outcomes if (found := limit(load, o)) is not None})
    return [
        str(load.cameras),
        f"{good} of {len(outcomes)}",
        f"{min(o.frames_per_s for o in outcomes):.0f}",
        f"{max(o.longest_write_s for o in outcomes):.2f}",
        f"{max(o.fullest_s for o in outcomes):.2f}",
        f"{max(left_s(load, o) for o in outcomes):.2f}",
        str(sum(o.lost_ticks for o in outcomes)),
        f"{sum(o.unseen_bytes for o in outcomes) / 1e6:.1f}",
        f"{max(o.flush_s for o in outcomes) * 1e3:.0f}",
        f"{alone / 1e6:.0f}",
        f"{np.mean([o.cpu for o in outcomes]):.2f}",
        f"{np.mean([o.emulator_cpu for o in outcomes]):.2f}",
        " and ".join(limits) or "-",
    ]


def _run_row(load: Load, number: int, o: Outcome) -> list[str]:
    return [
        str(load.cameras),
        str(number),
        not_sustained(load, o) or "sustained",
        f"{o.frames_per_s:.0f}",
        f"{o.longest_write_s:.3f}",
        f"{o.fullest_s:.3f}",
        f"{o.buffer_s:.3f}",
        f"{left_s(load, o):.3f}",
        str(o.lost_ticks),
        str(o.unseen_bytes),
        str(o.wrong_frames),
        f"{o.flush_s * 1e3:.0f}",
        f"{o.waited_s:.3f}",
        f"{max(c.stats.idle_worst_ms for c in o.clip.cameras):.2f}",
        f"{o.cpu:.2f}",
        f"{o.emulator_cpu:.2f}",
    ]


def _cameras(n: int) -> str:
    return f"{n} camera{'s' * (n != 1)}"


def _worst(outcomes: Sequence[Outcome]) -> str:
    longest, fullest = max(o.longest_write_s for o in outcomes), max(outcomes, key=lambda o: o.fullest_s / o.buffer_s)
    return (
        f"in all runs: the longest write took {longest:.2f} s; the fullest buffer held {fullest.fullest_s:.2f} of "
        f"{fullest.buffer_s:.2f} s; {sum(o.lost_ticks for o in outcomes)} ticks lost and listed as gaps; "
        f"{sum(o.unseen_bytes for o in outcomes)} bytes lost unseen"
    )
