"""Times without a read in flight."""

from __future__ import annotations

from spike4dgs.generators.recorder.usb.reader import Idle


def test_an_empty_queue_is_timed_from_the_newest_end() -> None:
    idle = Idle()
    for t in (0, 1, 2):
        idle.submitted(t, False, True)
    idle.ended(100)
    idle.submitted(130, True, True)  # the other two have ended as well, and are reported later
    idle.ended(101)
    idle.submitted(131, False, True)
    assert idle.starved == 0
    idle.ended(110)
    assert (idle.starved, idle.total_ns, idle.worst_ns) == (1, 20, 20)
    alone = Idle()
    for at, end in ((0, 10), (14, 20), (22, 30)):
        alone.submitted(at, at > 0, True)
        alone.ended(end)
    assert (alone.starved, alone.total_ns, alone.worst_ns, alone.reads) == (2, 6, 4, 3)
