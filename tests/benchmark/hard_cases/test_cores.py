from __future__ import annotations

import os

from spike4dgs.benchmark.hard_cases.cores import bytes_by_cores, core_counts, equal_bytes, on_cores


def test_counts_go_from_one_to_all_cores() -> None:
    counts, cores = core_counts(), len(os.sched_getaffinity(0))
    assert counts[0] == 1 and counts[-1] == cores and counts == sorted(set(counts))


def test_a_process_is_on_fewer_cores_and_then_on_all_again() -> None:
    before = os.sched_getaffinity(0)
    with on_cores(1):
        assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(0) == before


def test_what_depends_on_the_cores_is_found() -> None:
    assert bytes_by_cores(lambda: b"same").error == 0
    if len(core_counts()) > 1:
        assert bytes_by_cores(lambda: bytes([len(os.sched_getaffinity(0))] * 3)).error == 3


def test_differing_bytes_are_counted_and_named() -> None:
    found = equal_bytes([b"abcd", b"abcd", b"axyd"], ["one", "two", "three"])
    assert found.error == 2 and found.came_out == "4 bytes; three differ"
    assert equal_bytes([b"abcd", b"abc"], ["one", "two"]).error == 4, "another length: all of them"
