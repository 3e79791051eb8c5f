"""The table of the noise of audited scenes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.studies.scene_noise import COLUMNS, scene_noise

_STREAMS = {"whole_db": 55.12, "moving_db": 47.93, "object_db": None, "correlation_moving": 0.25}
_TRUTH = {"whole_db": 58.0, "moving_db": 53.0, "object_db": 52.5, "correlation_moving": 0.1}


def report(folder: Path, scene: str, audit: object) -> None:
    times = {"total_s": 300.4, "stages_s": {"key frames": 100.0, "audit": 80.0}}
    (folder / f"{scene}.report.json").write_text(json.dumps({"scene": scene, **times, "audit": audit}))


def test_a_row_has_the_audits_figures_and_the_time_without_it(tmp_path, capsys):
    noise = {"streams": _STREAMS, "truth": _TRUTH, "truth_against_paths": {"moving_db": 48.0}}
    report(tmp_path, "car-0-small", {"noise": noise, "ticks": {"total": {"mean_percent": 1.26}}})
    report(tmp_path, "van-0-small", None)  # not audited: no row
    assert scene_noise((tmp_path,), out=tmp_path / "out") == 0
    head, _, *rows = (tmp_path / "out/noise.md").read_text().splitlines()
    assert head == f"| {' | '.join(COLUMNS)} |"
    assert rows == ["| car-0-small | 220 | 55.1 / 47.9 / - | 0.25 | 58.0 / 53.0 / 52.5 | 1.3 | 48.0 |"]
    assert "car-0-small" in capsys.readouterr().out and (tmp_path / "out/noise.png").stat().st_size > 1000


def test_folders_without_an_audit_are_refused(tmp_path):
    with pytest.raises(UserError, match="expected reports of audited scenes, found none; "):
        scene_noise((tmp_path,), out=tmp_path / "out")
    report(tmp_path, "car-0-small", None)
    with pytest.raises(UserError, match="found 1 reports without an audit"):
        scene_noise((tmp_path,), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
