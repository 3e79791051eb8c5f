"""Capture: the clip holds the frames that the cameras sent, at their ticks, also after faults."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from fake_camera import FakeCamera, frames_of, layout_of, rig, rig_of

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.recorder.capture import capture
from spike4dgs.generators.recorder.frames.clip import ARRIVAL_TIMES, FRAME_TAGS, CameraClip
from spike4dgs.generators.recorder.frames.cutting import agree
from spike4dgs.generators.recorder.frames.gaps import Gap
from spike4dgs.generators.recorder.frames.layouts import COUNTER
from spike4dgs.generators.recorder.rig_profile import RigProfile
from spike4dgs.generators.recorder.sync import Rate
from spike4dgs.generators.recorder.usb.reads import SHORT, UNPLUGGED

N = 200  # ticks of most clips
SECONDS = N / 20000


def make(n: int, layout: str = "plain", **changes: object) -> tuple[RigProfile, list[UInt8], dict[str, FakeCamera]]:
    profile = rig(n, layout, **changes)
    frames = [frames_of(i, layout_of(profile), 2 * N) for i in range(n)]
    return profile, frames, rig_of(frames, profile)


def check_frames(camera: CameraClip, frames: UInt8, n_ticks: int) -> None:
    """Check that every frame is the source's at its tick, and that gaps are exactly the other ticks."""
    np.testing.assert_array_equal(camera.frames, frames[camera.ticks])
    absent = [t for g in camera.gaps for t in range(g.first_tick, g.stop_tick)]
    assert sorted([*camera.ticks.tolist(), *absent]) == list(range(n_ticks))
    assert camera.stats.lost_ticks == len(absent)


@pytest.mark.parametrize("layout", ["plain", "tagged-rows"])
def test_a_clip_holds_the_frames_that_the_cameras_sent(layout: str) -> None:
    profile, frames, links = make(3, layout)
    states: list[str] = []
    clip = capture(profile, links, SECONDS, on_state=states.append)
    assert states == ["OPEN", "ARMED", "TRIGGERED", "DRAIN", "CLOSED"]
    assert clip.complete and not clip.interrupted and clip.n_ticks == N
    assert clip.sync == (FRAME_TAGS if layout == "tagged-rows" else ARRIVAL_TIMES)
    assert [c.camera for c in clip.cameras] == ["cam_00", "cam_01", "cam_02"]
    for camera, source in zip(clip.cameras, frames, strict=True):
        assert camera.ticks.tolist() == list(range(N))
        check_frames(camera, source, N)
        assert camera.frames.base is not None, "a view of the ring, not a copy"
        assert camera.stats.end == "ok" and camera.stats.bytes >= camera.frames.size


def test_secondaries_are_started_before_the_primary_and_stopped_after_it() -> None:
    profile, _, links = make(3)
    capture(profile, links, SECONDS)
    once = ["start cam_00", "start cam_02", "start cam_01", "stop cam_01", "stop cam_02", "stop cam_00"]
    assert links["cam_00"].log[:12] == 2 * once, "the rehearsal, and the capture"
    assert sorted(links["cam_00"].log[12:]) == [f"close cam_{i:02d}" for i in range(3)]


def test_common_counters_decide_which_tick_is_the_first() -> None:
    profile = rig(3, "tagged-rows")
    layout = layout_of(profile)
    ahead = [0, 7, 3]  # frames that a camera has sent before the others; its counter wraps in the middle of it
    frames = frames_of(0, layout, 3 * N, COUNTER - 5)
    links = rig_of([frames[a:] for a in ahead], profile)
    clip = capture(profile, links, SECONDS)
    assert clip.complete and clip.sync == FRAME_TAGS
    for camera in clip.cameras:
        np.testing.assert_array_equal(camera.frames, frames[7 : 7 + N])


def test_counters_of_their_own_decide_nothing() -> None:
    profile = rig(2, "tagged-rows")
    frames = [frames_of(i, layout_of(profile), 2 * N, first) for i, first in enumerate((10, 3_000_000))]
    clip = capture(profile, rig_of(frames, profile), SECONDS)
    assert clip.complete and clip.sync == ARRIVAL_TIMES
    for camera, source in zip(clip.cameras, frames, strict=True):
        check_frames(camera, source, N)


@pytest.mark.parametrize(("most", "expected"), [(2, None), (3, 1)])
def test_agreement_takes_the_wrap_of_counters(most: int, expected: int | None) -> None:
    assert agree([COUNTER - 1, 1, COUNTER - 2], most) == expected


def test_an_interruption_keeps_the_ticks_that_every_camera_has() -> None:
    profile, frames, links = make(3, timeout_ms=60_000)
    links["cam_00"].stream, links["cam_01"].stream = frames[0][:150].reshape(-1), frames[1][:160].reshape(-1)
    links["cam_02"].faults = {30 * 20: UNPLUGGED}
    stop = threading.Event()

    def end(rates: Mapping[str, Rate]) -> None:
        if rates["cam_00"].ticks == 150 and rates["cam_01"].ticks == 160 and rates["cam_02"].ticks == 20:
            stop.set()

    clip = capture(profile, links, 400 / 20000, stop=stop, on_rate=end)
    assert clip.interrupted and clip.n_ticks == 150
    for i, camera in enumerate(clip.cameras):
        check_frames(camera, frames[i], 150)
    assert [len(c.ticks) for c in clip.cameras] == [150, 150, 20]


def test_an_interruption_keeps_the_ticks_of_the_others_when_one_camera_was_torn() -> None:
    """Without counters nothing later of it can be a tick, though its reads go on."""
    profile, frames, links = make(2, "line-tagged", timeout_ms=60_000)
    size = frames[1].shape[1]
    links["cam_00"].stream = frames[0][:150].reshape(-1)
    links["cam_01"].stream = np.delete(frames[1][:160].reshape(-1), slice(30 * size + 5, 30 * size + 9))
    stop = threading.Event()

    def end(rates: Mapping[str, Rate]) -> None:
        if rates["cam_00"].ticks == 150 and rates["cam_01"].ticks >= 158:
            stop.set()

    clip = capture(profile, links, 400 / 20000, stop=stop, on_rate=end)
    assert clip.interrupted and clip.n_ticks == 150
    check_frames(clip.cameras[0], frames[0], 150)
    assert len(clip.cameras[0].ticks) == 150 and len(clip.cameras[1].ticks) == 30
    assert [(g.first_tick, g.ticks) for g in clip.cameras[1].gaps] == [(30, 120)]


def test_a_clip_ends_where_all_cameras_failed() -> None:
    profile, _, links = make(2)
    for camera, tick in (("cam_00", 40), ("cam_01", 60)):
        links[camera].faults = {30 * tick: UNPLUGGED}
    clip = capture(profile, links, SECONDS)
    assert clip.interrupted and clip.n_ticks == 60
    assert [g.first_tick for camera in clip.cameras for g in camera.gaps] == [40]


def test_small_reads_keep_the_end_of_a_clip_whose_camera_cannot_be_stopped() -> None:
    profile = replace(rig(1, "line-tagged"), width=1000, height=1000, transfer_bytes=1024)
    frames = [frames_of(0, layout_of(profile), 60)]
    links = rig_of(frames, profile)
    links["cam_00"].restartable = False
    clip = capture(profile, links, 10 / 20000)
    assert clip.complete and clip.n_ticks == 10


def test_an_interruption_keeps_the_ticks_of_the_others_when_one_camera_never_had_a_whole_frame() -> None:
    profile, frames, links = make(2, "tagged-rows", timeout_ms=60_000)
    links["cam_00"].stream, links["cam_01"].stream = frames[0][:150].reshape(-1), np.zeros(1024, np.uint8)
    stop = threading.Event()

    def end(rates: Mapping[str, Rate]) -> None:
        if rates["cam_00"].ticks == 150:
            stop.set()

    clip = capture(profile, links, SECONDS, stop=stop, on_rate=end)
    assert clip.interrupted and clip.n_ticks == 150
    for camera, source in zip(clip.cameras, frames, strict=True):
        check_frames(camera, source, 150)
    assert [len(c.ticks) for c in clip.cameras] == [150, 0]


def test_ctrl_c_is_an_interruption_and_not_an_error() -> None:
    profile, frames, links = make(2, timeout_ms=60_000)
    for link in links.values():
        link.limit = 4 * 1024
    fastest = 0.0

    def press(rates: Mapping[str, Rate]) -> None:
        nonlocal fastest
        assert set(rates) == {"cam_00", "cam_01"}
        fastest = max(fastest, rates["cam_00"].bytes_per_s)
        if all(rate.ticks == 4096 // 30 for rate in rates.values()):
            raise KeyboardInterrupt

    clip = capture(profile, links, 400 / 20000, on_rate=press)
    assert clip.interrupted and clip.complete and clip.n_ticks == 4096 // 30 and fastest > 0
    check_frames(clip.cameras[0], frames[0], clip.n_ticks)
    assert links["cam_00"].log[-1].startswith("close")


@pytest.mark.parametrize("layout", ["plain", "tagged-rows"])
def test_short_reads_between_frames_cost_no_memory_and_so_no_tick(layout: str) -> None:
    """Each second frame ends a read: far more reads than the memory has room for whole ones."""
    profile, frames, links = make(2, layout)
    size = layout_of(profile).frame_bytes
    for link in links.values():
        link.faults = {size * tick: SHORT for tick in range(2, N, 2)}
    clip = capture(profile, links, SECONDS)
    assert clip.complete and clip.n_ticks == N
    for camera, source in zip(clip.cameras, frames, strict=True):
        assert camera.stats.short_reads > N // 3
        check_frames(camera, source, N)


def test_a_loss_in_the_first_frame_shifts_no_tick_where_counters_are_the_cameras_own() -> None:
    profile = rig(2, "tagged-rows")
    frames = [frames_of(i, layout_of(profile), 2 * N, first) for i, first in enumerate((10, 3_000_000))]
    links = rig_of([frames[0], np.delete(frames[1].reshape(-1), slice(5, 9))], profile)
    clip = capture(profile, links, SECONDS)
    assert clip.sync == ARRIVAL_TIMES and clip.n_ticks == N
    for camera, source in zip(clip.cameras, frames, strict=True):
        check_frames(camera, source, N)
    assert [camera.gaps for camera in clip.cameras] == [(), (Gap("cam_01", 0, 1, "torn frame"),)]


def test_data_without_a_frame_of_the_layout_are_told_of() -> None:
    profile, _, links = make(2, "tagged-rows")
    for i, link in enumerate(links.values()):
        link.stream = np.random.default_rng(i).integers(0, 256, 2 * N * 50, dtype=np.uint8)
    expected = r"camera cam_0\d: expected frames of layout tagged-rows, 24x10, found 0.0\d* MB without one; corr"
    with pytest.raises(UserError, match=expected):
        capture(profile, links, SECONDS)


def test_a_camera_that_sends_nothing_is_no_array() -> None:
    profile, _, links = make(2)
    links["cam_00"].stream = np.empty(0, np.uint8)
    with pytest.raises(UserError, match="camera cam_00: expected data after its start sequence, found time-out; check"):
        capture(profile, links, SECONDS)
    assert {f"close cam_{i:02d}" for i in range(2)} <= set(links["cam_00"].log)


def test_a_camera_that_ignores_its_stop_sequence_is_refused() -> None:
    """Its stream would begin anywhere in a frame after the second start."""
    profile, _, links = make(2)
    links["cam_00"].stops = False
    with pytest.raises(UserError, match="camera cam_00: expected silence after its stop sequence, found it goes on"):
        capture(profile, links, SECONDS)
    assert "close cam_01" in links["cam_00"].log


def test_an_interruption_before_the_first_tick_is_an_error() -> None:
    profile, _, links = make(2)
    stop = threading.Event()
    stop.set()
    with pytest.raises(UserError, match="expected a whole tick of every camera"):
        capture(profile, links, SECONDS, stop=stop)


def test_an_error_of_the_sink_ends_the_capture() -> None:
    profile, _, links = make(2)

    def sink(camera: str, first_tick: int, raw: UInt8) -> None:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        capture(profile, links, SECONDS, sink=sink)
    assert "close cam_01" in links["cam_00"].log


@pytest.mark.parametrize("layout", ["plain", "tagged-rows"])
def test_cameras_that_cannot_be_stopped_go_on_from_the_rehearsal(layout: str) -> None:
    profile = rig(2, layout)
    frames = [frames_of(i, layout_of(profile), 4000) for i in range(2)]
    links = rig_of(frames, profile)
    for link in links.values():
        link.restartable, link.bytes_per_s = False, 1e6
    clip = capture(profile, links, SECONDS)
    assert clip.complete and clip.n_ticks == N
    starts = set()
    for camera, source in zip(clip.cameras, frames, strict=True):
        first = int(np.nonzero((source == camera.frames[0]).all(axis=1))[0][0])
        np.testing.assert_array_equal(camera.frames, source[first : first + N])
        starts.add(first)
    assert min(starts) > 0, "frames before the trigger are dropped"
    if layout == "tagged-rows":
        assert len(starts) == 1, "the counters determine which frames belong together"


@pytest.mark.parametrize("layout", ["plain", "tagged-rows"])
def test_a_camera_that_sends_nothing_until_the_others_have_agreed_is_recorded_whole(layout: str) -> None:
    profile = rig(2, layout, timeout_ms=60_000)
    size = layout_of(profile).frame_bytes
    frames = [frames_of(i, layout_of(profile), 3000) for i in range(2)]
    links, seen = rig_of(frames, profile), list[int]()
    for link in links.values():
        link.restartable, link.limit = False, 1024  # a read in the rehearsal

    def let_first_go(state: str) -> None:
        if state == "TRIGGERED":
            links["cam_00"].limit = None

    def let_second_go(rates: Mapping[str, Rate]) -> None:
        seen.append(rates["cam_00"].ticks)
        if len(seen) > 1 and seen[-2] > 2100:  # more than is waited for, and an agreement since
            links["cam_01"].limit = None

    clip = capture(profile, links, SECONDS, on_state=let_first_go, on_rate=let_second_go)
    assert clip.complete and clip.n_ticks == N
    for camera, source in zip(clip.cameras, frames, strict=True):
        first = -(-1024 // size)
        np.testing.assert_array_equal(camera.frames, source[first : first + N])


def test_arrival_is_the_tick_that_was_complete_when_a_read_ended() -> None:
    profile, _, links = make(1)
    camera = capture(profile, links, SECONDS).cameras[0]
    expected = [1024 * (i + 1) // 30 for i in range(len(camera.arrival))]
    assert camera.arrival[:, 0].tolist() == expected
    assert (np.diff(camera.arrival[:, 1]) >= 0).all()
