"""The table of the noise of audited scenes."""

import json
from pathlib import Path

import pytest
from small_scenes import add_gap

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.studies.scene_noise import COLUMNS, scene_noise

_STREAMS = {"whole_db": 55.12, "moving_db": 47.93, "object_db": None, "correlation_moving": 0.25}
_TRUTH = {"whole_db": 58.0, "moving_db": 53.0, "object_db": 52.5, "correlation_moving": 0.1}
_NOISE = {"streams": _STREAMS, "truth": _TRUTH, "truth_against_paths": {"moving_db": 48.0}}
_AUDIT = {"noise": _NOISE, "ticks": {"total": {"mean_percent": 1.26}}}


def report(folder: Path, scene: str, audit: object) -> None:
    times = {"total_s": 300.4, "stages_s": {"key frames": 100.0, "audit": 80.0}}
    (folder / f"{scene}.report.json").write_text(json.dumps({"scene": scene, **times, "audit": audit}))


def test_a_row_has_the_audits_figures_and_the_time_without_it(small_scene, tmp_path, capsys):
    folder, scene = small_scene.parent, open_scene(small_scene)
    report(folder, small_scene.name, _AUDIT)
    report(folder, "van-0-small", None)  # not audited: no row
    assert scene_noise((folder,), out=tmp_path / "out") == 0
    head, _, *rows = (tmp_path / "out/noise.md").read_text().splitlines()
    assert head == f"| {' | '.join(COLUMNS)} |"
    names = f"{small_scene.name} | {scene.revision[:12]}"
    assert rows == [f"| {names} | 220 | 55.1 / 47.9 / - | 0.25 | 58.0 / 53.0 / 52.5 | 1.3 | 48.0 |"]
    add_gap(small_scene, "cam_01", 30, 2)
    assert scene_noise((folder,), out=tmp_path / "out") == 0, "audited scenes may have lost ticks"
    assert small_scene.name in capsys.readouterr().out and (tmp_path / "out/noise.png").stat().st_size > 1000


def test_a_page_keeps_the_rows_of_other_scenes(small_scene, tmp_path):
    others = ["| a-0-small | 1 | 2 |", "| z-0-small | 1 | 2 |"]
    old = f"| {small_scene.name} | its row before |"
    page = tmp_path / "page.md"
    page.write_text(
        "\n".join(["| no row |", "<!-- noise -->", "| head |", "| --- |", *others, old, "<!-- end noise -->"])
    )
    report(small_scene.parent, small_scene.name, _AUDIT)
    assert scene_noise((small_scene.parent,), out=tmp_path / "out", page=page) == 0
    before, start, head, rule, *rows, end = page.read_text().splitlines()
    assert (before, start, head) == ("| no row |", "<!-- noise -->", f"| {' | '.join(COLUMNS)} |")
    assert rule.startswith("| --- |") and end == "<!-- end noise -->"
    new = (tmp_path / "out/noise.md").read_text().splitlines()[2]
    assert rows == sorted([*others, new])


@pytest.mark.parametrize("text", [None, b"no block\n", b"<!-- noise -->\n\xe4\n<!-- end noise -->\n"])
def test_a_page_without_the_block_is_refused_before_the_work(small_scene, tmp_path, text):
    page = tmp_path / "page.md"
    if text is not None:
        page.write_bytes(text)
    report(small_scene.parent, small_scene.name, _AUDIT)
    with pytest.raises(UserError, match=r"page\.md: expected"):
        scene_noise((small_scene.parent,), out=tmp_path / "out", page=page)
    assert not (tmp_path / "out").exists()


def test_folders_without_an_audit_are_refused(tmp_path):
    with pytest.raises(UserError, match="expected reports of audited scenes, found none; "):
        scene_noise((tmp_path,), out=tmp_path / "out")
    report(tmp_path, "car-0-small", None)
    with pytest.raises(UserError, match="found 1 reports without an audit"):
        scene_noise((tmp_path,), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
