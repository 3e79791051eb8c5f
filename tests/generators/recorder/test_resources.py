"""Memory for data that wait for the disk, and real-time priority."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from fake_camera import rig

from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.cli import main
from spike4dgs.generators.recorder.emulation.array import scene_profile
from spike4dgs.generators.recorder.resources import buffer_seconds, bytes_per_s, free_bytes, least_seconds, real_time

FAST = replace(rig(3), width=400, height=250, transfer_bytes=1 << 20, transfers=16)  # 250 MB/s a camera


@pytest.mark.parametrize(
    ("free_kb", "clip_s", "expected"),
    [
        (6_000_000, 60.0, 0.5 * 6_000_000 * 1024 / 750e6),  # half of it
        (60_000_000, 60.0, 10.0),  # more is of no use
        (6_000_000, 1.0, 1.0 + 2 * 16 * 2**20 / 250e6),  # the clip, beside the reads in flight
        (100_000, 60.0, 2 * 16 * 2**20 / 250e6),  # no less than the reads in flight need
    ],
)
def test_the_default_is_half_of_what_is_free_within_bounds(free_kb: int, clip_s: float, expected: float) -> None:
    free = free_kb * 1024
    assert bytes_per_s(FAST) == 250e6
    assert buffer_seconds(FAST, clip_s, free) == pytest.approx(expected, rel=1e-12)
    assert buffer_seconds(replace(FAST, ring_seconds=0.25), clip_s, free) == 0.25, "the profile's own"
    least = 2 * 16 * 2**20 / 250e6
    assert buffer_seconds(replace(FAST, ring_seconds=0.05), clip_s, free) == least, "with room for the reads in flight"


def test_the_system_says_what_is_free() -> None:
    assert 0 < free_bytes() < psutil.virtual_memory().total
    assert least_seconds(FAST) == pytest.approx(0.1342, abs=1e-4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--buffer-s", "2"), "--buffer-s: expected --continuous beside it"),
        (("--buffer-s", "0", "--continuous"), "--buffer-s: expected seconds above 0, found 0"),
        (("--buffer-s", "nan", "--continuous"), "--buffer-s: expected a number from -1e+12 to 1e+12, found nan"),
        (("--buffer-s", "1e6", "--continuous"), "lower --buffer-s"),
    ],
)
def test_a_buffer_that_cannot_be_is_refused(
    tmp_path: Path, small_scene: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], message: str
) -> None:
    out = tmp_path / "x"
    assert main(["record", "--emulate", str(small_scene), "--out", str(out), *arguments]) == 2
    assert message in capsys.readouterr().err and not out.exists()


def test_a_buffer_smaller_than_the_reads_in_flight_is_enlarged(
    tmp_path: Path, small_scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["record", "--emulate", str(small_scene), "--out", str(tmp_path / "x"), "--continuous"]
    assert main([*command, "--buffer-s", "0.001"]) in (0, 3)  # a disk that stalls costs ticks
    rig = scene_profile(open_scene(small_scene), transfer_bytes=3072)
    assert f"memory for {least_seconds(rig):.3g} s of all cameras" in capsys.readouterr().out


def policy_of(thread: threading.Thread) -> int:
    return os.sched_getscheduler(thread.native_id or 0)


def test_all_threads_have_it_while_it_lasts() -> None:
    end = threading.Event()
    before = threading.Thread(target=end.wait)
    before.start()
    try:
        with real_time() as permitted:
            if not permitted:
                pytest.skip("this user may not have real-time priority")
            within = threading.Thread(target=end.wait)
            within.start()
            assert [policy_of(t) for t in (threading.main_thread(), before, within)] == 3 * [os.SCHED_RR]
        assert [policy_of(t) for t in (threading.main_thread(), before, within)] == 3 * [os.SCHED_OTHER]
    finally:
        end.set()


REFUSED = """
import os, resource
from spike4dgs.generators.recorder.resources import real_time
if os.getuid() == 0:
    os.setuid(65534)
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
with real_time() as permitted:
    print(permitted, os.sched_getscheduler(0) == os.SCHED_OTHER)
"""


def test_a_system_that_refuses_it_is_no_error() -> None:
    done = subprocess.run([sys.executable, "-c", REFUSED], capture_output=True, text=True, timeout=60)
    assert done.stdout == "False True\n", done.stderr
