"""Figures of quality that pages have outside generated blocks. A ratchet holds their number: it only falls.

`loose_figures.json` has the most that each page may have. Other figures, such as times, are not counted.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from spike4dgs.benchmark.files import read_json, write_json
from spike4dgs.studies.kit.blocks import KINDS, pattern
from spike4dgs.studies.results.pages import pages_of

_RATCHET = Path("studies", "results", "loose_figures.json")  # in a checkout
_GENERATED = pattern(*KINDS)
_FENCE = re.compile(r"^ *```.*?^ *```", re.MULTILINE | re.DOTALL)
_NUMBER = r"\d+(?:\.\d+)?"
_DECIBELS = re.compile(rf"(?:{_NUMBER}(?:\s*(?:,|/|-|and|to|or)\s*))*{_NUMBER}\s+dB\b")  # "7.8 and 7.1 dB" are two
_IN_TABLE = re.compile(r"(?<![\d.])\d+\.\d{2,}(?![\d.])")


def loose_figures(text: str) -> Iterator[tuple[int, str]]:
    """Yield (line, figure) for numbers in dB, and in tables those with two decimals or more, outside generated blocks.

    Code blocks are left out.

    >>> list(loose_figures("It leads by 7.8 and 7.1 dB.\\n\\n| row | PSNR |\\n| x | 30.25 |"))
    [(1, '7.8'), (1, '7.1'), (4, '30.25')]
    """
    for hidden in (_GENERATED, _FENCE):
        text = hidden.sub(lambda found: "\n" * found[0].count("\n"), text)
    places = {}
    for found in _DECIBELS.finditer(text):
        for number in re.finditer(_NUMBER, found[0]):
            places[found.start() + number.start()] = number[0]
    start = 0
    for line in text.splitlines(keepends=True):
        if line.lstrip().startswith("|"):
            places |= {start + number.start(): number[0] for number in _IN_TABLE.finditer(line)}
        start += len(line)
    for place in sorted(places):
        yield text.count("\n", 0, place) + 1, places[place]


def counts(root: Path) -> dict[str, int]:
    """Return the number of loose figures of each page that has any, by its path in the checkout."""
    found = {
        page.relative_to(root).as_posix(): sum(1 for _ in loose_figures(page.read_text("utf-8")))
        for page in pages_of(root)
    }
    return {page: count for page, count in found.items() if count}


def risen(found: Mapping[str, int], most: Mapping[str, int]) -> list[str]:
    """Return a line for each page with more loose figures than the ratchet allows."""
    return [
        f"{page}: {count}, {most.get(page, 0)} allowed" for page, count in found.items() if count > most.get(page, 0)
    ]


def read_ratchet(root: Path) -> dict[str, int]:
    """Return the most loose figures that each page of a checkout may have."""
    return read_json(root / _RATCHET, "the ratchet of loose figures")


def tighten(root: Path, found: Mapping[str, int]) -> None:
    """Write the counts into the ratchet where they have fallen."""
    most = read_ratchet(root)
    lower = {page: min(count, found.get(page, 0)) for page, count in most.items()}
    if (kept := {page: count for page, count in lower.items() if count}) != most:
        write_json(root / _RATCHET, kept)
