from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from spike4dgs.leaderboard.rank import flags_of

CHECK = {"images": 3, "equal_images": 0, "equal_pixels": 0.04, "ceiling_db": None}


def entry(finished: Path, truth: dict[str, Any] | None = None, **method: Any) -> dict[str, Any]:
    record = copy.deepcopy(json.loads((finished / "out/results/rough.json").read_text()))
    record["method"].update(method)
    return {"record": record, "verification": {"truth": {"pattern-0": truth} if truth else {}}}


def check(share: float | None = None, error: float | None = None, **changes: Any) -> dict[str, Any]:
    return {**CHECK, "noise_share": share, "noise_share_error": error, **changes}


@pytest.mark.parametrize(
    ("trained_on", "flagged"),
    [
        ((), False),
        (("car-1-small", "pattern-2"), False),
        (("pattern-01", "my-pattern-0", "pattern-0-long", "pattern-0.v2"), False),
        (("pattern-0",), True),
        (("scenes PATTERN-0, and others.",), True),
        (("pattern-0@0123",), True),
        (("data/pattern-0/",), True),
    ],
)
def test_trained_on_is_checked_against_scene_ids(finished: Path, trained_on: tuple[str, ...], flagged: bool) -> None:
    expected = ["trained on test scenes (pattern-0)"] if flagged else []
    assert flags_of(entry(finished, trained_on=[*trained_on])) == expected


def test_trained_on_is_checked_against_revisions(finished: Path) -> None:
    revision = entry(finished)["record"]["dataset"]["scenes"]["pattern-1"]
    assert flags_of(entry(finished, trained_on=[f"sha256:{revision}"])) == ["trained on test scenes (pattern-1)"]


@pytest.mark.parametrize(
    ("truth", "flag"),
    [
        (check(), None),
        (check(0.4, 0.2), None),
        (check(0.1, 0.0), None),
        (check(-3.0, 0.1), None),
        (check(0.3, 0.02), "carries the truth's noise (pattern-0)"),
        (check(equal_images=1), "equals truth (pattern-0)"),
        (check(equal_pixels=0.3), "equals truth (pattern-0)"),
        (check(ceiling_db=200.0), None),
    ],
)
def test_flags_follow_from_what_was_measured(finished: Path, truth: dict[str, Any], flag: str | None) -> None:
    assert flags_of(entry(finished, truth)) == ([flag] if flag else [])


def test_no_score_is_above_the_ceiling(finished: Path) -> None:
    psnr = entry(finished)["record"]["scenes"]["pattern-0"]["metrics"]["psnr"]
    assert not flags_of(entry(finished, check(ceiling_db=psnr)))
    (flag,) = flags_of(entry(finished, check(ceiling_db=psnr - 0.2)))
    assert flag == f"above the noise ceiling (pattern-0 has {psnr:.1f} of {psnr - 0.2:.1f} dB)"
