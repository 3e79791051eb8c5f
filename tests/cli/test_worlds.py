"""The table of worlds."""

import json

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.cli.worlds import COLUMNS, worlds
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import WORLDS


def table(path):
    """Read a Markdown table as a list of {column: cell}."""
    lines = [x for x in path.read_text().splitlines() if x.startswith("|")]
    cells = [[c.strip() for c in line.strip("|").split("|")] for line in lines]
    assert cells[0] == list(COLUMNS) and set(cells[1]) == {"---"}
    return [dict(zip(cells[0], row, strict=True)) for row in cells[2:]]


def test_a_row_agrees_with_the_geometry_and_the_report(tmp_path, capsys):
    report = {"scene": "turntable-0-tiny", "total_s": 83.4, "stages_s": {"key frames": 60.0, "audit": 21.0}}
    (tmp_path / "turntable-0-tiny.report.json").write_text(json.dumps(report))
    out = tmp_path / "made" / "worlds.md"
    assert worlds(("turntable",), profile="tiny", reports=tmp_path, out=out) == 0
    (row,) = table(out)
    assert "turntable" in capsys.readouterr().out
    assert (row["world"], row["speed, m/s"], row["length, m"], row["made in, s"]) == ("turntable", "10.1", "0.64", "62")

    world = WORLDS["turntable"].build(0, 0, 0.004)
    views = cameras(world, 64, 40, (0, 2, 4, 7))
    fastest = 0.0  # of the vertices on the rim, by central differences over 2 us
    for t in np.linspace(0, 0.004, 33):
        for camera in views:
            before, after = (camera.project(world.moving_points(t + d))[0] for d in (-1e-6, 1e-6))
            fastest = max(fastest, np.linalg.norm(after - before, axis=1).max() / 2e-6)
    assert float(row["fastest point, px/ms"]) == pytest.approx(fastest / 1000, rel=0.02)
    spacings = [int(s) for s in row["key spacing, ticks"].split(" / ")]
    assert spacings == sorted(spacings, reverse=True) and all(20 % s == 0 for s in spacings)
    assert spacings[-1] * fastest / 20_000 <= 0.5

    # the disc is an ellipse as wide as its diameter at its distance, and the objects on it add a little
    (camera,) = cameras(world, 64, 40, (4,))
    uv, depth = camera.project(world.moving_points(0.0))
    disc = np.pi / 4 * np.ptp(uv[:, 0]) * np.ptp(uv[:, 1]) / (64 * 40)
    assert 0.7 * disc < float(row["moving pixels, %"]) / 100 < 1.1 * disc
    near, far = (float(x) for x in row["depth, m"].split(" to "))
    assert world.depth_range[0] <= near <= depth.min() + 0.1 and depth.max() < far <= world.depth_range[1]


def test_a_scene_that_is_not_made_has_no_time(tmp_path):
    assert worlds(("bird",), profile="tiny", variant=1, reports=tmp_path, out=tmp_path / "w.md") == 0
    (row,) = table(tmp_path / "w.md")
    assert row["made in, s"] == "-" and "Ticks are 50 us" in (tmp_path / "w.md").read_text()


@pytest.mark.parametrize(("content", "found"), [("{}", "total_s"), ("[1]", "list"), ('{"total_s": "x"}', "total_s")])
def test_a_foreign_report_is_refused(tmp_path, content, found):
    (tmp_path / "turntable-0-tiny.report.json").write_text(content)
    with pytest.raises(UserError, match=found):
        worlds(("turntable",), profile="tiny", reports=tmp_path, out=tmp_path / "w.md")
    assert not (tmp_path / "w.md").exists()


def test_unknown_names_are_refused(tmp_path):
    with pytest.raises(UserError, match="moon"):
        worlds(("car", "moon"), out=tmp_path / "w.md")
    with pytest.raises(UserError, match="--profile"):
        worlds(("car",), profile="huge", out=tmp_path / "w.md")
    with pytest.raises(UserError, match="--seed and --variant: expected numbers from 0 up, found 0, -1"):
        worlds(("car",), variant=-1, out=tmp_path / "w.md")
    with pytest.raises(UserError, match="--reports"):
        worlds(("car",), reports=tmp_path / "nowhere", out=tmp_path / "w.md")
