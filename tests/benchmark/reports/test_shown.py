"""Error maps: colours and levels of known errors, and the choice of a scale."""

from pathlib import Path
from typing import Any

import numpy as np
from dummy_methods import CountMethod, run
from matplotlib import colormaps
from rich.console import Console
from small_scenes import write_small_scene

from spike4dgs.benchmark.reports.console import Columns, print_results, seeds_of_methods
from spike4dgs.benchmark.reports.error_map import choose_scale, error_image, error_levels, scale_name
from spike4dgs.benchmark.reports.paper_files import write_results_table
from spike4dgs.benchmark.runs.record import missing_cell


def test_colours_are_those_of_the_colour_map_at_the_share_of_the_scale() -> None:
    truth = np.full((1, 5), 0.5, np.float32)
    image = truth + np.array([[0, 0.05, -0.05, 0.1, 0.4]], np.float32)
    for scale in (0.3, 0.1, 0.01):
        shares = np.clip(np.array([0, 0.05, 0.05, 0.1, 0.4]) / scale, 0, 1)
        expected = colormaps["magma"](np.rint(shares * 255).astype(int))[:, :3] * 255
        np.testing.assert_allclose(error_image(image, truth, scale)[0], expected, atol=4)


def test_levels_give_the_error_back() -> None:
    errors = np.linspace(0, 0.3, 500, dtype=np.float32)[None]
    back = 0.3 * (error_levels(0.2 + errors, np.full_like(errors, 0.2)) / 255.0) ** 2
    assert np.abs(back - errors).max() < 0.3 / 255 and np.abs(back - errors)[errors < 0.01].max() < 3e-4
    assert error_levels(np.ones((1, 1), np.float32), np.zeros((1, 1), np.float32)) == 255


def test_a_scale_leaves_out_two_percent_at_most_and_has_a_name() -> None:
    for share, scale in ((0.015, 0.03), (0.03, 0.1)):
        errors = np.full(1000, 0.02, np.float32)
        errors[: int(1000 * share)] = 0.08
        assert choose_scale([errors[:400], errors[400:]]) == scale
    assert choose_scale([np.ones(10, np.float32)]) == 0.3 and choose_scale([np.zeros(10, np.float32)]) == 0.01
    assert choose_scale([]) == 0.3
    names = [scale_name(s) for s in (0.3, 0.1, 0.03, 0.01)]
    assert names == [f"error \N{MULTIPLICATION SIGN}{k}" for k in (1, 3, 10, 30)]


def printed(records: list[dict[str, Any]], width: int = 240, columns: Columns = "short") -> str:
    console = Console(width=width)
    with console.capture() as capture:
        print_results(console, records, columns)
    return capture.get()


def test_the_short_table_fits_a_terminal_and_cuts_no_name(small_scene: Path, tmp_path: Path) -> None:
    name = "spike4dgs-x+self-calibrated2"
    (record,) = run(tmp_path, [small_scene], CountMethod(name), metrics=("psnr", "ssim"))
    for width in (80, 100):
        text = printed([record], width)
        assert max(map(len, text.splitlines())) <= width and "\N{HORIZONTAL ELLIPSIS}" not in text
        (row,) = (line.split() for line in text.splitlines() if name in line)
        assert row[1] == f"{record['mean']['psnr']:.2f}" and "pattern-0" in text
    assert "temporal" not in text
    assert "temporal" in printed([record], 80, "all") and name in printed([record], 80, "all")


def test_tables_for_papers_have_the_best_in_bold(small_scene: Path, tmp_path: Path) -> None:
    (record,) = run(tmp_path / "run", [small_scene], CountMethod("ours[motion.lr_grid=0.1]"), metrics=("psnr", "ssim"))
    cell = record["scenes"]["pattern-0"]
    worse = {**cell, "metrics": {**cell["metrics"], "psnr": cell["metrics"]["psnr"] - 1}}
    other = {**record, "method": {**record["method"], "name": "a_method"}, "scenes": {"pattern-0": worse}}
    write_results_table(tmp_path, [record, other])
    markdown, latex = (tmp_path / "table.md").read_text(), (tmp_path / "table.tex").read_text()
    psnr, less = f"{cell['metrics']['psnr']:.2f}", f"{worse['metrics']['psnr']:.2f}"
    assert f"| ours[motion.lr_grid=0.1] | **{psnr}** |" in markdown and f"| a_method | {less} |" in markdown
    assert rf"ours[motion.lr\_grid=0.1] & \textbf{{{psnr}}} &" in latex and rf"a\_method & {less} &" in latex
    header, first = (line.split(" & ") for line in latex.splitlines() if " & " in line and "a\\_" not in line)
    assert len(header) == len(first) == 1 + latex.partition("{l")[2].partition("}")[0].count("r")


def test_means_over_fewer_scenes_are_not_beside_the_others(small_scene: Path, tmp_path: Path) -> None:
    scenes = [small_scene, write_small_scene(tmp_path / "other", seed=1)]
    (whole,) = run(tmp_path / "a", scenes, CountMethod("whole"), metrics=("psnr",))
    (part,) = run(tmp_path / "b", scenes[1:], CountMethod("part"), metrics=("psnr",))
    text = printed([whole, part])
    assert text.count("part") == 1 and text.count("whole") == 3, "a row a scene, and the mean of both"


def test_a_seed_that_failed_leaves_no_mean(small_scene: Path, tmp_path: Path) -> None:
    records = run(tmp_path, [small_scene], CountMethod(), seeds=3, metrics=("psnr",))
    values = [r["mean"]["psnr"] for r in records]
    assert f"{np.mean(values):.2f} ± {np.std(values, ddof=1):.2f}" in printed(records)
    failed = {**records[2], "scenes": {"pattern-0": missing_cell("failed", "no luck")}}
    text = printed([*records[:2], failed])
    assert text.count("counts") == 1 and "(failed)" in text and "±" not in text.partition("higher")[0]
    assert f"{values[0]:.2f}" in printed(records[:1]) and "±" not in printed(records[:1])


def test_records_of_another_budget_or_with_other_parameters_are_rows_of_their_own() -> None:
    def record(seed: int, budget: float | None, **params: Any) -> dict[str, Any]:
        cell = {"status": "failed" if budget is None else "ok", "budget": budget}
        return {"method": {"name": "m", "seed": seed, "params": params}, "scenes": {"s": cell}}

    records = [record(0, 1.0), record(1, None), record(0, 0.5), record(2, 1.0), record(0, 1.0, steps=3)]
    assert seeds_of_methods(records) == [[records[0], records[1], records[3]], [records[2]], [records[4]]]
