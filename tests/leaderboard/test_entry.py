from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from submissions import edit, enter

from spike4dgs.benchmark.errors import UserError
from spike4dgs.leaderboard.rank import write_leaderboard


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e.update(label="certified"), "at label"),
        (lambda e: e.update(note="x"), "'note' was unexpected"),
        (lambda e: e["record"].update(note="x"), "at record"),
        (
            lambda e: e["record"]["method"].update(name="other"),
            "/tfp+4dgs, found pattern-0+pattern-1/other",
        ),
        (lambda e: e["record"]["mean"].update(psnr=50.0), "expected psnr ="),
    ],
)
def test_damaged_entries_are_refused_by_name(done: Path, change: Any, message: str) -> None:
    path = enter(done)
    edit(path, change)
    with pytest.raises(UserError) as e:
        write_leaderboard(done / "board")
    assert "tfp+4dgs.json" in str(e.value) and message in str(e.value)
