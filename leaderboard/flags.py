"""Flags: reasons not to rank an entry, which follow from the entry and the release alone."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from spike4dgs.leaderboard.tracks import current_release

MAX_EQUAL_PIXELS = 0.25  # half floats of good renderings equal the truth's in a few percent of the pixels
MAX_NOISE_SHARE = 0.1  # 0 for honest predictions; a tenth of the truth mixed in gives as much
STANDARD_ERRORS = 5.0  # beyond chance: the noise has heavy tails, and honest fits of van reach three
COPY, NOISE, CEILING, TRAINED = (
    "equals truth",
    "carries the truth's noise",
    "above the noise ceiling",
    "trained on test scenes",
)


def flags_of(entry: Mapping[str, Any]) -> list[str]:
    """Return the flags of an entry, each with the scenes that it comes from; none for what may be ranked."""
    record, truth = entry["record"], entry["verification"]["truth"]
    release, found = current_release(), dict[str, list[str]]()
    for scene, cell in sorted(record["scenes"].items()):
        for flag in _of_truth(truth.get(scene)):
            found.setdefault(flag, []).append(scene)
        revision, psnr = record["dataset"]["scenes"][scene], cell["metrics"]["psnr"]
        ceiling = release.ceiling_db(scene, revision) or truth.get(scene, {}).get("ceiling_db")
        if psnr is not None and ceiling is not None and psnr > ceiling:
            found.setdefault(CEILING, []).append(f"{scene} has {psnr:.1f} of {ceiling:.1f} dB")
        if any(_names(text, name) for text in record["method"]["trained_on"] for name in (scene, revision)):
            found.setdefault(TRAINED, []).append(scene)
    return [f"{flag} ({', '.join(scenes)})" for flag, scenes in found.items()]


def _of_truth(check: Mapping[str, Any] | None) -> Iterator[str]:
    if check is None:
        return
    if check["equal_images"] or check["equal_pixels"] > MAX_EQUAL_PIXELS:
        yield COPY
    share, error = check["noise_share"], check["noise_share_error"]
    if share is not None and share - STANDARD_ERRORS * error > MAX_NOISE_SHARE:
        yield NOISE


def _names(text: str, name: str) -> bool:
    """Return whether a text has a name as a word of its own: car-1-small does not name car-1-small-lens."""
    return re.search(rf"(?<![\w.-]){re.escape(name)}(?![\w.-]*\w)", text, re.IGNORECASE) is not None
