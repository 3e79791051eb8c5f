"""Six thousand hostile cases: frame tags, torn and lost blocks, profiles. Only documented errors, no wrong tick.

Each seed from Hypothesis is a batch of cases; a failure names the seed and the case.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rig_text import POSED

from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.recorder.frames.layouts import LAYOUTS, Layout, make_layout
from spike4dgs.generators.recorder.frames.ticks import Run, TickCounter
from spike4dgs.generators.recorder.rig_profile import RigProfile, load_profile

TAG_CASES, STREAM_CASES, PROFILE_CASES = 1000, 1000, 1000  # streams: for each layout
BATCH = 100
SIZES = {"plain": (13, 5), "padded-rows": (16, 3), "tagged-rows": (16, 6), "line-tagged": (24, 4)}


def batches(cases: int) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Run a test of one batch on as many seeds as make `cases`."""

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        seeds = given(seed=st.integers(0, 2**63))
        return settings(max_examples=cases // BATCH, deadline=None, derandomize=True, database=None)(seeds(test))

    return decorate


# ---------------------------------------------------------------- tags


@batches(TAG_CASES)
def test_frames_are_known_by_their_tags_and_one_wrong_tag_is_enough(seed: int) -> None:
    rng = np.random.default_rng(seed)
    layout = make_layout("tagged-rows", 8 * int(rng.integers(1, 9)), int(rng.integers(4, 40)))
    first = int(rng.choice([0, 65_530, 2**31, 2**32 - 40, int(rng.integers(2**32))]))
    payload = rng.integers(0, 256, (BATCH, layout.payload_bytes), dtype=np.uint8)
    raw, out = layout.pack(payload, first), np.empty_like(payload)
    truth = (first + np.arange(BATCH)) % 2**32
    layout.unpack(raw, out)
    np.testing.assert_array_equal(out, payload)
    np.testing.assert_array_equal(layout.counts(raw), truth)
    tags = raw.reshape(BATCH, layout.height, -1)[:, :, -2:]
    row, byte = rng.integers(layout.height, size=BATCH), rng.integers(2, size=BATCH)
    tags[np.arange(BATCH), row, byte] ^= rng.integers(1, 256, BATCH, dtype=np.uint8)
    np.testing.assert_array_equal(layout.counts(raw), -1)


# ---------------------------------------------------------------- streams


@dataclass
class Sent:
    """The data of a camera: its frames, the events by which they arrive, and which of them arrive in one piece."""

    frames: np.ndarray  # [n, frame_bytes]
    first_count: int
    events: list[tuple[str, Any]] = field(default_factory=list)  # ("feed", bytes), ("skip" or "lose", number of bytes)
    whole: set[int] = field(default_factory=set)
    kinds: set[str] = field(default_factory=set)  # of faults


def camera_stream(rng: np.random.Generator, layout: Layout) -> Sent:
    """Return frames with a few faults: bytes known to be dropped, bytes lost with and without a report, noise, repeats.

    Layouts without tags have no silent faults, which they cannot detect, and `line-tagged` one, which is not a whole
    number of frames.
    """
    n, size = int(rng.integers(1, 14)), layout.frame_bytes
    first = int(rng.choice([0, 2**32 - 4, int(rng.integers(2**32))]))
    payload = rng.integers(0, 256, (n, layout.payload_bytes), dtype=np.uint8)
    if layout.name == "tagged-rows" and rng.random() < 0.5:  # in the dark frames differ only in their tags
        payload[:] = 0
    sent = Sent(layout.pack(payload, first), first)
    data = sent.frames.ravel()
    # Sometimes reading begins in the middle of a frame.
    at = piece = int(rng.integers(size)) if layout.has_tags and rng.random() < 0.3 else 0
    silent = {"plain": 0, "padded-rows": 0, "line-tagged": 1, "tagged-rows": 3}[layout.name]
    for cut in np.sort(rng.integers(at, data.size + 1, rng.integers(0, 5))).tolist():
        kind, amount = str(rng.choice(["skip", "lose", "silent", "noise", "again"])), int(rng.integers(1, 3 * size))
        cut = max(cut, at)
        back = min(amount, cut - at)
        if kind in ("silent", "noise", "again"):
            vanishes = not layout.count_tags and (back if kind == "again" else amount) % size == 0
            if silent == 0 or vanishes:
                continue
            silent -= 1
        sent.kinds.add(kind)
        sent.events.append(("feed", data[at:cut]))
        sent.whole |= set(range(-(-piece // size), cut // size))
        at = piece = cut
        if kind == "noise":
            sent.events.append(("feed", rng.integers(0, 256, amount, dtype=np.uint8)))
        elif kind == "again":
            piece = cut - back
            sent.events.append(("feed", data[piece:cut]))
        else:
            at = piece = min(cut + amount, data.size)
            sent.events += [(kind, at - cut)] * (kind != "silent")
    sent.events.append(("feed", data[at:]))
    sent.whole |= set(range(-(-piece // size), data.size // size))
    return sent


def replay(counter: TickCounter, sent: Sent, rng: np.random.Generator) -> list[Run]:
    """Feed a counter with the camera's data, cut at random."""
    runs: list[Run] = []
    for kind, what in sent.events:
        if kind == "skip":
            counter.skip(what, "overflow")
        elif kind == "lose":
            counter.lose("short read")
        else:
            for part in np.split(what, np.sort(rng.integers(0, len(what) + 1, rng.integers(0, 4)))):
                runs += counter.feed(part)
    return runs


def check(layout: Layout, sent: Sent, rng: np.random.Generator) -> None:
    """Check that each frame has its own tick, each tick is in a frame or a gap, and whole frames are kept."""
    origin, lead = None, 0
    if layout.count_tags and rng.random() < 0.5:
        lead = int(rng.integers(-3, 4))
        origin = (sent.first_count + lead) % 2**32
    counter = TickCounter(layout, "cam_00", origin)
    known = {"tagged-rows": layout.width // 4 + 2, "line-tagged": layout.width // 16 + 2}.get(layout.name, 0)
    runs, ticks = replay(counter, sent, rng), list[int]()
    # Pixels before the first tag that no dark image imitates are not protected.
    if runs and layout.has_tags and origin is None:  # the first whole frame is tick 0
        lead = int(np.nonzero((sent.frames[:, known:] == runs[0].frames[0, known:]).all(axis=1))[0][0])
        assert runs[0].first_tick == 0 and lead <= min(sent.whole, default=lead)
    for run in runs:
        ticks += range(run.first_tick, run.first_tick + len(run.frames))
        truth = sent.frames[run.first_tick + lead :][: len(run.frames)]
        assert np.array_equal(run.frames[:, known:], truth[:, known:])
    assert ticks == sorted(set(ticks))
    n_ticks = len(sent.frames) + 3
    covered = ticks + [t for gap in counter.finish(n_ticks) for t in range(gap.first_tick, gap.stop_tick)]
    assert sorted(covered) == list(range(n_ticks))
    gentle = sent.kinds <= {"skip"} or (layout.count_tags and "skip" not in sent.kinds)
    if gentle:
        assert {i - lead for i in sent.whole if i >= lead} <= set(ticks)


@pytest.mark.parametrize("name", LAYOUTS)
def test_no_loss_gives_a_frame_a_wrong_tick(name: str) -> None:
    layout = make_layout(name, *SIZES[name])

    @batches(STREAM_CASES)
    def batch(seed: int) -> None:
        for case in range(BATCH):
            rng = np.random.default_rng([seed, case])
            try:
                check(layout, camera_stream(rng, layout), rng)
            except Exception as e:
                e.add_note(f"seed {seed}, case {case}")
                raise

    batch()


# ---------------------------------------------------------------- profiles


VALUES = r"""0 -1 1 3.5 true nan inf -inf 1e999 99999999999999999999 0x0403 "" "a" "\u0000" "../x" "cam_00" '"' [] [1]
[[]] ["00"] ["zz"] {} {a=1} [{}] 1979-05-27 [[1,0,0],[0,1,0],[0,0,1]] [[1,0],[0]] [1e308,1e308,1e308] "plain"
"line-tagged" "primary" "secondary" "top-down" 1024 1_000 1e400 "\ud800" 0b1""".split()
LINES = """[transfer] [defaults] [[camera]] [camera.calibration] [calibration] calibration="rig.toml" calibration="."
held_out=["a"] held_out=["a","a"] schema=1 fps=0 x=1 = ]] [camera] camera=1 start=["0"]
stop=["00"] endpoint_out=1 id="a" serial="1" a.b=1 fx=1 rotation=[[1,0,0],[0,1,0],[0,0,1]] translation=[0,0]""".split()


def mutated(text: str, rng: np.random.Generator) -> bytes:
    """Return a profile with some lines and values changed, and sometimes a byte."""
    lines = text.splitlines()
    for _ in range(rng.integers(1, 5)):
        i = int(rng.integers(len(lines)))
        kind = rng.integers(6)
        if kind == 0:
            del lines[i]
        elif kind == 1:
            lines.insert(i, str(rng.choice(LINES)))
        elif kind == 2:
            lines.insert(i, lines[int(rng.integers(len(lines)))])
        elif kind == 3:
            lines[i] = re.sub(r"=.*", lambda _: f"= {rng.choice(VALUES)}", lines[i])
        elif kind == 4:
            lines[i] = lines[i][: int(rng.integers(len(lines[i]) + 1))]
        else:
            j = int(rng.integers(len(lines)))
            lines[i], lines[j] = lines[j], lines[i]
        lines = lines or [""]
    data = bytearray("\n".join(lines).encode())
    if data and rng.random() < 0.1:
        data[int(rng.integers(len(data)))] = int(rng.integers(256))
    return bytes(data)


def test_a_profile_is_read_or_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    read = 0

    @batches(PROFILE_CASES)
    def batch(seed: int) -> None:
        nonlocal read
        for case in range(BATCH):
            path.write_bytes(mutated(PROFILE, np.random.default_rng([seed, case])))
            try:
                profile = load_profile(path)
            except UserError as e:
                assert "\n" not in str(e) and str(e).startswith((str(path), str(tmp_path))), path.read_bytes()
            except Exception as e:
                e.add_note(f"seed {seed}, case {case}: {path.read_bytes()!r}")
                raise
            else:
                read += 1
                check_profile(profile)

    batch()
    assert PROFILE_CASES / 50 < read < PROFILE_CASES / 2  # the mutations spoil some profiles, not all


def check_profile(profile: RigProfile) -> None:
    """Check the facts that the recorder relies on."""
    layout = make_layout(profile.layout, profile.width, profile.height)
    assert len({c.serial for c in profile.cameras}) == len({c.id for c in profile.cameras}) == len(profile.cameras) > 0
    assert [c.role for c in profile.cameras].count("primary") == 1
    assert profile.calibrated or all(c.calibration is None for c in profile.cameras)
    assert profile.transfer_bytes % 1024 == 0 and profile.transfers > 0 and profile.fps > 0
    assert layout.frame_bytes > 0 and (profile.ring_seconds is None or profile.ring_seconds > 0)
    assert set(profile.held_out) < {c.id for c in profile.cameras}
    assert all(c.endpoint_out is not None or not c.start + c.stop for c in profile.cameras)


CHANGES = (
    ('"plain"', '"tagged-rows"\nheld_out = ["right"]'),
    ("in_flight = 2", "in_flight = 2\nring_seconds = 0.5"),
    ("endpoint_in = 0x82", "endpoint_in = 0x82\nstop = []"),
    ('role = "primary"', 'role = "primary"\nmirrored = true'),
)
PROFILE = functools.reduce(lambda text, change: text.replace(*change), CHANGES, POSED)
