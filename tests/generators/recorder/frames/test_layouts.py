"""Frame layouts against slow twins that work on single bits, and ticks across losses."""

from __future__ import annotations

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.recorder.frames.gaps import Gap
from spike4dgs.generators.recorder.frames.layouts import LAYOUTS, Layout, make_layout
from spike4dgs.generators.recorder.frames.ticks import Run, TickCounter

SIZES = {"plain": (400, 250), "padded-rows": (400, 250), "tagged-rows": (400, 250), "line-tagged": (1000, 1000)}
SMALL = {"plain": (21, 5), "padded-rows": (24, 3), "tagged-rows": (24, 6), "line-tagged": (24, 6)}


def packed_ticks(width: int, height: int, n: int, seed: int = 0) -> np.ndarray:
    spikes = np.random.default_rng(seed).random((n, height * width)) < 0.4
    return np.packbits(spikes, axis=1, bitorder="little")


def bit(data: np.ndarray, i: int) -> int:
    return int(data[i >> 3]) >> (i & 7) & 1


def tagged_frame(payload: np.ndarray, width: int, height: int, count: int) -> list[int]:
    """Return a frame of tagged rows, from Python's integers."""
    low, high = count % 2**16, count // 2**16
    frame: list[int] = []
    for r in range(height):
        frame += payload[r * width // 8 : (r + 1) * width // 8].tolist()
        word = ((high + 40503 * low if r % 2 else low) + 257 * r) % 2**16
        frame += [word & 255, word >> 8]
    return frame


def line_frame(payload: np.ndarray, width: int, height: int) -> list[int]:
    """Return a frame of tagged blocks, bit by bit, in the order of the format's description."""
    half = height // 2
    order = [(line, c) for line in range(half, 0, -1) for c in (0, 1)]
    order += [(line, c) for line in range(1, half + 1) for c in (2, 3)]
    frame: list[int] = []
    for b, (line, channel) in enumerate(order):
        bits = [bit(payload, b * (width // 2) + i) for i in range(width // 2)]
        bits += [line >> i & 1 for i in range(10)] + [channel >> i & 1 for i in range(2)]
        frame += [sum(bits[8 * j + i] << i for i in range(8)) for j in range(len(bits) // 8)]
    return frame


def twin(layout: Layout, payload: np.ndarray, count: int) -> list[int]:
    if layout.name == "tagged-rows":
        return tagged_frame(payload, layout.width, layout.height, count)
    if layout.name == "padded-rows":
        return np.pad(payload.reshape(layout.height, -1), ((0, 0), (0, 2))).ravel().tolist()
    return line_frame(payload, layout.width, layout.height) if layout.name == "line-tagged" else payload.tolist()


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("sizes", [SMALL, SIZES])
def test_frames_equal_those_of_the_slow_twin_both_ways(name: str, sizes: dict[str, tuple[int, int]]) -> None:
    layout = make_layout(name, *sizes[name])
    n, first = 3 if sizes is SMALL else 1, 2**32 - 2
    payload = packed_ticks(layout.width, layout.height, n)
    raw = np.array([twin(layout, p, (first + i) % 2**32) for i, p in enumerate(payload)], np.uint8)
    assert raw.shape == (n, layout.frame_bytes)
    np.testing.assert_array_equal(layout.pack(payload, first), raw)
    out = np.empty_like(payload)
    layout.unpack(raw, out)
    np.testing.assert_array_equal(out, payload)
    assert layout.counts(raw).tolist() == [(first + i) % 2**32 if layout.count_tags else 0 for i in range(n)]


def test_published_frame_sizes() -> None:
    assert [make_layout(name, *SIZES[name]).frame_bytes for name in LAYOUTS] == [12_500, 13_000, 13_000, 128_000]
    assert make_layout("line-tagged", 1000, 1000).payload_bytes == 125_000


@pytest.mark.parametrize(
    ("name", "width", "height", "message"),
    [
        ("padded-rows", 401, 250, "expected a width that is a multiple of 8, found"),
        ("columns", 400, 250, "expected one of plain, padded-rows, tagged-rows, line-tagged, found 'columns'"),
        ("plain", 0, 250, "found 0x250"),
        ("tagged-rows", 401, 250, "expected a width that is a multiple of 8"),
        ("tagged-rows", 400, 3, "4 rows or more"),
        ("line-tagged", 400, 250, "expected a width of 8 more than a multiple of 16"),
        ("line-tagged", 1000, 999, "an even height"),
    ],
)
def test_sizes_that_a_layout_cannot_have(name: str, width: int, height: int, message: str) -> None:
    with pytest.raises(UserError, match=message):
        make_layout(name, width, height)


@pytest.mark.parametrize("name", ["tagged-rows", "line-tagged"])
def test_a_frame_is_found_at_any_byte_and_only_there(name: str) -> None:
    layout = make_layout(name, *SMALL[name])
    frames = layout.pack(packed_ticks(*SMALL[name], 3), 7).ravel()
    for before in range(layout.frame_bytes):
        data = frames[layout.frame_bytes - before :]
        assert layout.find(data) == before
    assert layout.find(frames[1 : 2 * layout.frame_bytes - 1]) == -1
    assert layout.find(np.zeros(10 * layout.frame_bytes, np.uint8)) == -1


@pytest.mark.parametrize("distance", [1, 2, 255, 256, 257, 4096, 65535, 65537, 128 * 999])
def test_a_frame_of_two_parts_is_torn_wherever_they_meet_after_its_first_row(distance: int) -> None:
    layout = make_layout("tagged-rows", 400, 250)
    a = layout.pack(packed_ticks(400, 250, 1), 900)[0]
    b = layout.pack(packed_ticks(400, 250, 1, seed=1), 900 + distance)[0]
    for cut in [52, 103, 104, 6_000, 12_896, 12_947, 12_948, 12_998]:
        assert layout.counts(np.concatenate([a[:cut], b[cut:]])[None]).tolist() == [-1]


# ---------------------------------------------------------------- ticks


def tagged() -> tuple[Layout, np.ndarray]:
    layout = make_layout("tagged-rows", *SMALL["tagged-rows"])
    return layout, layout.pack(packed_ticks(*SMALL["tagged-rows"], 40), 2**32 - 10)


def ticks_of(runs: list[Run], frames: np.ndarray) -> list[int]:
    """Return the ticks of runs, and check that their contents are the frames with these numbers."""
    found = []
    for run in runs:
        for i, frame in enumerate(run.frames):
            np.testing.assert_array_equal(frame, frames[run.first_tick + i])
            found.append(run.first_tick + i)
    return found


@pytest.mark.parametrize("size", [1, 7, 30, 31, 64, 10_000])
@pytest.mark.parametrize("name", LAYOUTS)
def test_whole_streams_are_numbered_from_zero_however_they_are_cut(name: str, size: int) -> None:
    layout = make_layout(name, *SMALL[name])
    frames = layout.pack(packed_ticks(*SMALL[name], 12), 2**32 - 5)
    counter, runs = TickCounter(layout, "cam_00"), []
    for start in range(0, frames.size, size):
        runs += counter.feed(frames.ravel()[start : start + size])
    assert ticks_of(runs, frames) == list(range(12))
    assert counter.finish(12) == ()
    assert counter.finish(15) == (Gap("cam_00", 12, 3, "interrupted"),)


def test_frames_are_views_unless_they_straddle() -> None:
    layout, frames = tagged()
    data = frames[:8].ravel()
    runs = TickCounter(layout, "cam_00").feed(data)
    assert len(runs) == 1 and np.shares_memory(runs[0].frames, data)


def test_dropped_bytes_of_known_number_are_a_gap_of_exact_ticks() -> None:
    for name in LAYOUTS:
        layout = make_layout(name, *SMALL[name])
        frames, size = layout.pack(packed_ticks(*SMALL[name], 20)), layout.frame_bytes
        data, counter = frames.ravel(), TickCounter(layout, "cam_00")
        runs = counter.feed(data[: 3 * size + 5])
        counter.skip(4 * size, "overflow")  # up to byte 5 of frame 7, whose rest is of no use
        runs += counter.feed(data[7 * size + 5 : 12 * size])
        counter.skip(size, "overflow")
        runs += counter.feed(data[13 * size :])
        assert ticks_of(runs, frames) == [0, 1, 2, 8, 9, 10, 11, *range(13, 20)]
        gaps = counter.finish(20)
        assert gaps == (Gap("cam_00", 3, 5, "overflow"), Gap("cam_00", 12, 1, "overflow"))


def test_a_loss_of_unknown_size_is_bridged_by_counters_and_ends_a_camera_without() -> None:
    for name in LAYOUTS:
        layout = make_layout(name, *SMALL[name])
        frames, size = layout.pack(packed_ticks(*SMALL[name], 20), 99), layout.frame_bytes
        counter = TickCounter(layout, "cam_00")
        runs = counter.feed(frames.ravel()[: 3 * size + 5])
        counter.lose("short read")
        runs += counter.feed(frames.ravel()[8 * size + 9 :])
        back = list(range(9, 20)) if layout.count_tags else []
        assert ticks_of(runs, frames) == [0, 1, 2, *back]
        assert counter.finish(20) == (Gap("cam_00", 3, 6 if back else 17, "short read"),)


@pytest.mark.parametrize("reason", ["short read", "torn frame"])
def test_a_loss_in_the_first_frame_shifts_no_tick_where_the_first_byte_begins_it(reason: str) -> None:
    for name in LAYOUTS:
        layout = make_layout(name, *SMALL[name])
        frames, size = layout.pack(packed_ticks(*SMALL[name], 20), 99), layout.frame_bytes
        if reason == "torn frame" and not layout.has_tags:
            continue  # such a loss goes unnoticed
        counter = TickCounter(layout, "cam_00", 99 if layout.count_tags else None, from_start=True)
        runs = counter.feed(frames.ravel()[:5])
        if reason == "short read":
            counter.lose(reason)
        runs += counter.feed(frames.ravel()[size + 9 :])
        assert ticks_of(runs, frames) == (list(range(2, 20)) if layout.count_tags else [])
        assert counter.finish(20) == (Gap("cam_00", 0, 2 if layout.count_tags else 20, reason),)


def test_what_pads_a_row_is_dropped() -> None:
    layout, payload = make_layout("padded-rows", 400, 250), packed_ticks(400, 250, 2)
    raw, out = layout.pack(payload), np.empty_like(payload)
    raw.reshape(2, 250, 52)[:, :, 50:] = 0xA5
    layout.unpack(raw, out)
    np.testing.assert_array_equal(out, payload)


def test_torn_frames_repeats_and_leaps_never_yield_a_wrong_tick() -> None:
    layout, frames = tagged()
    size, data = layout.frame_bytes, frames.ravel()
    stream = [
        data[: 5 * size],
        data[3 * size : 5 * size],  # again: no new ticks
        data[5 * size : 9 * size + 11],
        data[12 * size + 11 : 15 * size],  # frame 9 goes on as frame 12
        data[20 * size : 22 * size],  # a leap at a frame's end
        data[22 * size + 1 : 30 * size],  # one byte lost
        np.random.default_rng(3).integers(0, 256, 3 * size, dtype=np.uint8),
        data[30 * size : 33 * size],
    ]
    counter = TickCounter(layout, "cam_00")
    runs = counter.feed(np.concatenate(stream))
    assert ticks_of(runs, frames) == [*range(9), 13, 14, 20, 21, *range(23, 33)]
    assert counter.finish(33) == (
        Gap("cam_00", 9, 4, "torn frame"),
        Gap("cam_00", 15, 5, "overflow"),
        Gap("cam_00", 22, 1, "torn frame"),
    )


def test_a_common_origin_drops_frames_before_the_trigger_and_shows_late_ones() -> None:
    layout, frames = tagged()  # counters from 2**32 - 10
    early = TickCounter(layout, "cam_00", origin=2**32 - 4)
    assert ticks_of(early.feed(frames[:20].ravel()), frames[6:]) == list(range(14))
    assert early.finish(14) == ()
    late = TickCounter(layout, "cam_01", origin=2**32 - 13)
    assert [run.first_tick for run in late.feed(frames.ravel())] == [3]
    assert late.finish(43) == (Gap("cam_01", 0, 3, "overflow"),)
