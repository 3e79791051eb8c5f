"""The plan has every row and cell once, what matters most first, and knowledge by recipe."""

from dataclasses import replace

import pytest

from spike4dgs.baselines import recipes as theirs
from spike4dgs.baselines.images.published.makers import MAKERS
from spike4dgs.benchmark.method import find_methods, make_budget
from spike4dgs.benchmark.reports.paper_tables import published
from spike4dgs.generators.make_dataset import SceneSettings, track_jobs
from spike4dgs.method import recipes as ours
from spike4dgs.method.tuned import SUFFIX as TUNED
from spike4dgs.studies.results import plan
from spike4dgs.studies.results.command import EVERY_GROUP
from spike4dgs.studies.results.tables.steps import GROUPS as STEPS

METHODS = find_methods()
MOTIONS = ("4dgs", "stg", "d3dgs")
ABOUT = {
    plan.CALIBRATED: {"spike4dgs", "spike4dgs-x"}
    | {f"{images}+rig-flat+{motion}" for images in ("tfi", "tfp", "spk2img", "adaptive") for motion in MOTIONS},
    plan.UNCALIBRATED: {"dy-spikegs", "dy-spikenerf", "tfp+static", "nearest-view", "spike4dgs-x+self-calibrated"}
    | {f"{images}+{motion}" for images in ("tfi", "tfp", "spk2img") for motion in MOTIONS}
    | {f"{maker.name}+{motion}" for maker in MAKERS for motion in ("stg", "4dgs")},
}


@pytest.mark.parametrize("group", [*plan.PLAN, *plan.ABLATIONS, plan.TRIAL], ids=lambda g: g.name)
def test_every_row_is_a_method_and_stands_once(group: plan.Group) -> None:
    names = [row.name for row in group.rows]
    assert len(names) == len(set(names)) and set(names) <= set(METHODS)
    assert all(row.seeds in (1, 2, 3) and row.tuned_on for row in group.rows)
    make_budget(group.budget)


@pytest.mark.parametrize("group", plan.PLAN, ids=lambda g: g.name)
def test_the_blocks_of_the_tables_follow_from_the_recipes(group: plan.Group) -> None:
    for knowledge, names in ABOUT.items():
        found = [row.name for row in group.rows if plan.knowledge_of(METHODS[row.name]) == knowledge]
        assert {name for name in found if not name.endswith(TUNED)} == names
        assert {name.removesuffix(TUNED) for name in found} == names


def test_a_row_is_tuned_where_a_search_of_it_is_kept() -> None:
    searched = {**theirs.SEARCHES, **ours.SEARCHES}
    rows = {row.name: row for row in plan.TABLE1.rows}
    assert {name for name in rows if name.endswith(TUNED)} == {f"{name}{TUNED}" for name in searched if name in rows}
    for name in searched.keys() & rows.keys():
        assert rows[f"{name}{TUNED}"].seeds == rows[name].seeds
        assert all(scene in rows[f"{name}{TUNED}"].tuned_on for scene in searched[name]["scenes"])


def test_a_row_is_tuned_on_the_same_scenes_in_every_group() -> None:
    tuned_on = {row.name: row.tuned_on for row in plan.TABLE1.rows}
    rows = [row for group in EVERY_GROUP for row in group.rows if row.name in tuned_on]
    assert any(row.name.endswith(TUNED) for group in STEPS for row in group.rows)
    assert [row for row in rows if row.tuned_on != tuned_on[row.name]] == []


def test_a_calibrated_row_is_one_whose_recipe_is_given_flat_fields() -> None:
    assert plan.knowledge_of(METHODS["tfp+rig-flat+stg"]) == plan.CALIBRATED
    assert plan.knowledge_of(METHODS["tfp+stg"]) == plan.UNCALIBRATED
    assert plan.knowledge_of(METHODS["tfp+4dgs+spike"]) == plan.CALIBRATED, "its loss knows the cameras' response"


def test_the_scenes_are_those_of_the_track() -> None:
    for group, number in ((plan.TABLE1, 1), (plan.TABLE2, 2)):
        jobs = track_jobs("ideal", published(number).worlds, SceneSettings())
        assert group.scenes == tuple(job.id for job in jobs)
    assert len({*plan.TABLE1.scenes, *plan.TABLE2.scenes}) == 9


def test_cells_stand_once_and_what_matters_most_comes_first() -> None:
    cells, nine = plan.cells_of(plan.PLAN), {*plan.TABLE1.scenes, *plan.TABLE2.scenes}
    assert len(cells) == len(set(cells)) == 9 * sum(row.seeds for row in plan.TABLE1.rows)
    once = replace(plan.TABLE1, rows=tuple(replace(row, seeds=1) for row in plan.TABLE1.rows))
    assert plan.cells_of([*plan.PLAN, once]) == cells, "a cell of two groups is one"
    order = [(cells[k].row, cells[k].seed) for k in range(0, len(cells), 9)]
    order = [(row, seed) for row, seed in order if not row.endswith(TUNED)]
    for k in range(0, len(cells), 9):
        assert {cell.scene for cell in cells[k : k + 9]} == nine
        assert len({(cell.row, cell.seed) for cell in cells[k : k + 9]}) == 1
    first = ["spike4dgs-x", "tfp+rig-flat+stg", "tfp+stg", "tfp+4dgs", "spk2img+stg", "spike4dgs"]
    first += ["adaptive+rig-flat+stg", "tfp+rig-flat+4dgs", "spk2img+rig-flat+stg"]
    assert [name for name, _ in order[:9]] == first
    assert [seed for _, seed in order] == sorted(seed for _, seed in order)
    assert {name for name, seed in order if seed == 2} >= {"spike4dgs-x", "spike4dgs", "tfp+rig-flat+stg", "tfp+stg"}


def test_ablations_have_the_rows_of_the_paper_that_need_no_other_weights() -> None:
    for group, number in zip(plan.ABLATIONS[:3], (3, 4, 7), strict=True):
        assert [r.name for r in group.rows] == [name for name in published(number).rows if "dust3r" not in name]
    assert [group.split for group in plan.TABLE5] == [f"views-{n}" for n in range(3, 9)]
    assert {group.scenes for group in plan.TABLE5} == {("turntable-0-small",)}
    tuned_on = {row.name: row.tuned_on for group in plan.ABLATIONS for row in group.rows}
    assert {tuned_on[name] for name in ("msdi+colmap+4dgs", "spike4dgs")} == {plan.OUR_TRIALS}
    assert tuned_on["spike4dgs-x+colmap"] == plan.X_TRIALS
    assert tuned_on["tfp+colmap+stg"] != plan.OUR_TRIALS and len(plan.UNPOSED.rows) == 14
