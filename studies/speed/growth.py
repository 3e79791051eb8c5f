"""Measurements of costs that grow with a size: the parts that those of all rooms share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from spike4dgs.benchmark.environment import available_cores
from spike4dgs.studies.speed.timing import by_turns_ms
from spike4dgs.studies.speed_error.measurement import (
    MEDIAN_MS,
    MS,
    Column,
    Measurement,
    Point,
    Request,
    Series,
)


def thread_counts() -> list[int]:
    """Return the numbers of threads to compare: powers of two up to 16, as many as this machine has cores."""
    return [n for n in (1, 2, 4, 8, 16) if n <= available_cores()]


def timed(calls: Mapping[float, Callable[[], Any]], name: str, column: str, turns: int) -> Series:
    """Return the series of calls by their size, which goes into `column`; each is timed `turns` times, by turns."""
    times = by_turns_ms(list(calls.values()), turns)
    points = (
        Point("", {column: size, "ms": best, "median_ms": median})
        for size, (best, median) in zip(calls, times, strict=True)
    )
    return Series(name, tuple(points))


def growth(
    id: str,
    title: str,
    words: str,
    column: Column,
    run: Callable[[Request], Iterable[Series]],
    seconds: tuple[float, float, float],
) -> Measurement:
    """Return the measurement of a cost that grows with `column`; `seconds` by size, from tiny to whole."""
    by_size = dict(zip(("tiny", "quick", "whole"), seconds, strict=True))
    columns = (column, MS, MEDIAN_MS)
    return Measurement(id, "How costs grow", title, words, "", "", columns, column.id, ("ms",), run, by_size)
