"""Points in less and less light: errors of known depths, and the table of a toy world."""

import json
from pathlib import Path

import numpy as np
import pytest
from toy_bursts import write_toy_shard

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.training_bursts import open_bursts
from spike4dgs.studies.poses import points
from spike4dgs.studies.poses.dark import see
from spike4dgs.studies.poses.points import FINDERS, dark_points, errors_of


def test_errors_are_relative_to_the_distance_and_ranked_by_sureness() -> None:
    true = np.array([[2.0, 4.0, 5.0, np.inf]])
    inverse = np.array([[1 / 2.0, 1 / 4.4, 1 / 6.0, 1.0]], np.float32)  # off by 0, 10 and 20 %, and nothing
    found = errors_of((inverse, np.array([[0.9, 0.5, 0.1, 1.0]], np.float32)), true)
    assert found == pytest.approx({"error": 0.1, "surer": 0.05, "rank": 1.0}, abs=1e-3)
    assert errors_of((inverse, np.array([[0.1, 0.5, 0.9, 0.0]], np.float32)), true)["rank"] == -1


def test_both_finders_see_a_bright_world(tmp_path: Path) -> None:
    file = open_bursts(write_toy_shard(tmp_path, 12, width=96, height=61, resting=1))
    burst = file.read(2)
    sight = see(burst, file, 1.0, 401, np.random.default_rng(0))
    for find in FINDERS.values():
        inverse, sure = find(sight)
        assert inverse.shape == sure.shape == (61, 96)
        assert errors_of((inverse, sure), burst.depth[0].astype(np.float64))["error"] < 0.05


def test_the_table_has_a_line_for_each_condition(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for variant in (12, 13):  # one hidden, one to train on
        write_toy_shard(tmp_path, variant, width=96, height=61, resting=2)
    monkeypatch.setattr(points, "LIGHTS", (1.0, 1 / 4))
    monkeypatch.setattr(points, "TICKS", (41,))
    assert dark_points(tmp_path, out=tmp_path / "out") == 0
    rows = json.loads((tmp_path / "out" / "points.json").read_text())["rows"]
    assert [(row["world"], row["light"], row["points"]) for row in rows] == [
        ("toy-12", light, name) for light in (1.0, 1 / 4) for name in FINDERS
    ]
    _, _, bright, dim = (tmp_path / "out" / "points.md").read_text().splitlines()
    assert bright.startswith(f"| 1 | 2 | {rows[0]['error']:.1%} |") and dim.startswith("| 1/4 | 2 |")


def test_a_folder_without_hidden_arrays_at_rest_is_refused(tmp_path: Path) -> None:
    write_toy_shard(tmp_path, 12)
    with pytest.raises(UserError, match="expected shards of hidden variants"):
        dark_points(tmp_path)
