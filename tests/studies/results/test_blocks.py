"""Tables of made-up records: the whole text, ties, intervals beside SciPy, and what may not be hidden."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import made_records
import numpy as np
import pytest
from PIL import Image
from scipy.stats import ttest_rel

from spike4dgs.benchmark.method import get_method
from spike4dgs.studies.results import blocks
from spike4dgs.studies.results.comparison import lead, rank, rows_of
from spike4dgs.studies.results.pages import BLOCKS
from spike4dgs.studies.results.plan import TABLE1, TABLE2, Group, Row, track_scenes
from spike4dgs.studies.results.records import with_finite
from spike4dgs.studies.results.tables.breaks import breaks_block
from spike4dgs.studies.results.tables.conditions import (
    CONDITIONS,
    CONTENT,
    REFINED,
    VIEWS,
    conditions_block,
    content_block,
)
from spike4dgs.studies.results.tables.conditions import GROUP as ON_CONDITIONS
from spike4dgs.studies.results.tables.covisible import covisible_block
from spike4dgs.studies.results.tables.images import TABLE6, images_block
from spike4dgs.studies.results.tables.modality import GROUP as ON_SENSORS
from spike4dgs.studies.results.tables.modality import NOISY, modality_block, noisy_block, plot_modality
from spike4dgs.studies.results.tables.paper import GROUP as PAPER
from spike4dgs.studies.results.tables.paper import paper_block
from spike4dgs.studies.results.tables.parts import GROUP as PARTS
from spike4dgs.studies.results.tables.parts import SWITCHES, own_scenes_block, parts_block, self_calibrated_block
from spike4dgs.studies.results.tables.published import pairs_block, published_block, unposed_block, views_block
from spike4dgs.studies.results.tables.realistic import GROUP as TRACK_SMALL
from spike4dgs.studies.results.tables.realistic import cameras_block, realistic_block
from spike4dgs.studies.results.tables.steps import GROUPS as STEPS
from spike4dgs.studies.results.tables.steps import steps_block

SHOWN = {  # a block -> two rows that it has, if not those of the tables
    "published": ("spike4dgs", "tfp+stg"),
    "table3": ("spike4dgs", "tfp+4dgs"),
    "table4": ("spike4dgs", "msdi+4dgs"),
    "table5": ("spike4dgs", "tfi+stg"),
    "table6": ("tfp.images", "msdi.images"),
    "table7": ("spike4dgs", "msdi+4dgs"),
    "unposed": ("spike4dgs-uncalibrated", "tfp+colmap+stg"),
    "modality-noisy": ("edi+stg", "rgb+stg"),
    "pairs": ("tfp+stg", "tfp+4dgs"),
    "cameras": ("spike4dgs-x", "tfp+stg"),
    "covisible": ("spike4dgs-x", "tfp+stg"),
    "own-scenes": ("spike4dgs-x",),
    "realistic": ("spike4dgs-x", "tfp+stg"),
    "self-calibrated": ("spike4dgs-x", "spike4dgs-x+self-calibrated"),
    "parts": ("spike4dgs-x",),
}
SCENES = ("bricks-0-small", "chips-0-small", "turntable-0-small", "bird-0-small")
OURS = "spike4dgs-x"
GROUP = Group("made", "Made", SCENES, (Row(OURS, 2, "here", True), *map(Row, ("a", "b", "c", "tfp+stg", "d"))))


def record(row: str, scene: str, moving: float, seed: int = 0, **changes: Any) -> dict[str, Any]:
    metrics = {"psnr": moving + 2, "ssim": 0.97, "psnr_dynamic": moving, "ssim_dynamic": 0.96, "flip": 0.05}
    metrics["psnr_covisible"] = moving + 3
    own = {
        "code": "00000000000b" if row.startswith("spike4dgs") else "00000000000a",
        "tuned_on": "here" if row == OURS else "elsewhere",
        "knowledge": "uncalibrated" if row == "tfp+stg" else "calibrated",
    }
    costs = {"bits_per_second": 5e8, "fit_seconds": 30.4, "render_fps": 120.6, "quiet": True}
    all_rows = {"commit": "c0ffee000000", "metrics": metrics, "cpu": "A processor, 2 cores", **costs}
    return made_records.record(row=row, scene=scene, seed=seed) | all_rows | own | changes


def made() -> list[dict[str, Any]]:
    """Ours is far ahead of a and b, which are even; c lacks scenes; tfp+stg knows less."""
    found = []
    for k, scene in enumerate(SCENES):
        found += [record(OURS, scene, 38 + k + 0.1 * seed, seed) for seed in (0, 1)]
        found.append(record("a", scene, 33 + k + 0.2 * (k % 2), quiet=False))
        found.append(record("b", scene, 33.1 + k))
        found.append(record("tfp+stg", scene, 31 + k))
    found.append(record("c", SCENES[0], 50.0))
    return [*found, record("c", SCENES[1], 0.0, metrics={}, fit_seconds=None, error="no weights")]


GOLDEN = """\
**Calibrated**: given the poses, and each camera's flat field and dark recording. Means of 4 scenes.

| rank | row | PSNR, moving | behind the first, dB | PSNR | SSIM | FLIP | fit, s | images/s | seeds |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
| 1 | `spike4dgs-x` | 39.55 |  | 41.55 | 0.9700 | 0.050 | 30 | 121 | 2 |
| 2-3 | `a` | 34.60 | 4.95 ± 0.30 | 36.60 | 0.9700 | 0.050 | (30) | (121) | 1 |
| 2-3 | `b` | 34.60 | 4.95 ± 0.10 | 36.60 | 0.9700 | 0.050 | 30 | 121 | 1 |

Incomplete, not ranked: `c` (1 of 4 scenes; chips-0-small, seed 0: no weights).

**Uncalibrated**: given the poses alone. Means of 4 scenes.

| rank | row | PSNR, moving | behind the first, dB | PSNR | SSIM | FLIP | fit, s | images/s | seeds |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
| 1 | `tfp+stg` | 32.50 |  | 34.50 | 0.9700 | 0.050 | 30 | 121 | 1 |

Planned and not measured yet: `d`.

Ranks are by PSNR where things move; rows that the intervals cannot tell apart share ranks. The number after ± is half \
of the 95 % interval of the paired difference over worlds, which holds for all rows of a block at once. Times in \
parentheses were measured while other programs ran.

Commit c0ffee000000; revisions of 4 scenes a175f1a1ca17; A processor, 2 cores; seeds 0, 1; budget quick; 21 of 28 \
planned cells, all finite, and 1 that failed. Tuned on: here (`spike4dgs-x`); elsewhere (the others).
"""


def test_the_text_of_a_table_is_this() -> None:
    assert "\n".join(blocks.table_block(GROUP, made())) == GOLDEN.strip()


def test_the_text_of_the_scenes_has_every_row_and_its_gaps() -> None:
    lines = blocks.scenes_block(GROUP, made())
    assert "| row | bricks | chips | turntable | bird |" in lines
    assert "| `spike4dgs-x` | 38.05 / 40.05 | 39.05 / 41.05 | 40.05 / 42.05 | 41.05 / 43.05 |" in lines
    assert "| `c` | 50.00 / 52.00 | - | - | - |" in lines
    assert lines[-1] == blocks.table_block(GROUP, made())[-1]


def test_a_lead_is_over_the_best_complete_row_with_equal_knowledge() -> None:
    def sentence(shift: float) -> str:
        moved = made()
        for r in moved:
            if r["row"] == OURS:
                r["metrics"]["psnr_dynamic"] += shift
        return blocks.lead_block(GROUP, moved)[2]

    assert sentence(0).startswith(
        "- `spike4dgs-x`, calibrated: 4.95 ± 0.20 dB ahead of `a` where things move, and 4.95"
    )
    assert "calibrated: even with `a` where things move (0.05 ± 0.20 dB), and" in sentence(-4.9)
    assert "calibrated: 1.05 ± 0.20 dB behind `a` where things move, and" in sentence(-6)
    assert "`c`" not in sentence(0) and "tfp+stg" not in sentence(0)
    headline = f"- calibrated, {sentence(0).removeprefix('- ').replace(', calibrated', '')}"
    assert blocks.headline_block(GROUP, made()) == [headline, "", "Commit c0ffee000000."]
    nobody = [r for r in made() if r["row"] in (OURS, "tfp+stg", "c")]
    for block in (blocks.lead_block, blocks.headline_block):
        assert block(GROUP, nobody) == [blocks.NO_LEAD] and block(GROUP, []) == [blocks.NOTHING]


@pytest.mark.parametrize("scenes", [4, 9])
def test_intervals_of_a_pair_are_those_of_the_paired_t_test(scenes: int) -> None:
    rng = np.random.default_rng(scenes)
    names = tuple(f"s{k}" for k in range(scenes))
    a, b = 30 + rng.normal(size=scenes), 28 + rng.normal(size=scenes)
    records = [record(row, s, v) for row, values in (("a", a), ("b", b)) for s, v in zip(names, values, strict=True)]
    first, second = rows_of(("a", "b"), names, records)
    found = lead(first, [second], "psnr_dynamic")
    assert found is not None
    interval = ttest_rel(a, b).confidence_interval(0.95)
    assert found.difference == pytest.approx(float(np.mean(a - b)))
    assert 2 * found.half_width == pytest.approx(interval.high - interval.low, rel=0.1)


def test_a_row_with_a_failed_cell_has_no_mean() -> None:
    """Else it would gain: the seed that failed where the row is bad would be left out of its mean."""
    seeds = [record(OURS, scene, 38 - 3 * seed, seed) for scene in SCENES for seed in (0, 1)]
    seeds[-1] |= {"metrics": {}, "error": "failed: diverged"}
    lines = blocks.table_block(GROUP, [*seeds, *(record("a", scene, 33.0) for scene in SCENES)])
    assert lines[4].startswith("| 1 | `a`") and not any(line.startswith("| 2") for line in lines)
    assert "Incomplete, not ranked: `spike4dgs-x` (4 of 4 scenes; bird-0-small, seed 1: failed: diverged)." in lines


def test_variants_of_a_world_tell_no_more_than_the_world() -> None:
    worlds, rng = [f"w{k}" for k in range(9)], np.random.default_rng(3)
    light = rng.normal(size=9)

    def half_width(variants: range) -> float:
        names = [f"{world}-{v}-small-realistic" for world in worlds for v in variants]
        values = np.repeat(light, len(variants))
        found = [record("a", s, 33 + v) for s, v in zip(names, values, strict=True)] + [
            record("b", s, 33.0) for s in names
        ]
        one, other = rows_of(("a", "b"), names, found)
        return lead(one, [other], "psnr_dynamic").half_width  # type: ignore[union-attr]

    assert half_width(range(3)) == pytest.approx(half_width(range(1)), rel=0.1)


def test_rows_of_equal_quality_share_ranks_and_the_order_is_that_of_means() -> None:
    rng, names = np.random.default_rng(1), [f"s{k}" for k in range(9)]
    means = {"best": 40.0, "x": 35.0, "y": 35.0, "z": 35.0, "worst": 20.0}
    light = rng.normal(scale=3, size=9)  # scenes differ more than rows do
    records = [
        record(row, s, mean + light[k] + rng.normal(scale=0.2))
        for row, mean in means.items()
        for k, s in enumerate(names)
    ]
    found = rank(rows_of(means, names, records))
    assert found.ranks == ("1", "2-4", "2-4", "2-4", "5")
    assert [row.name for row in found.rows][::4] == ["best", "worst"]
    assert list(found.behind) == sorted(found.behind) and found.half_widths[0] == 0


def test_seeds_that_not_every_scene_has_do_not_count() -> None:
    records = [record("a", s, 30 + seed, seed) for s in SCENES for seed in (0, 1, 2) if (s, seed) != (SCENES[0], 1)]
    (row,) = rows_of(("a",), SCENES, records)
    assert row.seeds == (0, 2) and row.mean("psnr_dynamic") == pytest.approx(31)


def test_a_table_has_the_seeds_of_its_plan() -> None:
    """A row that has three seeds for another table has one beside rows of one."""
    one = replace(GROUP, rows=tuple(replace(row, seeds=1) for row in GROUP.rows))
    text = blocks.table_block(one, [*made(), *(record("a", s, 99.0, seed=1) for s in SCENES)])
    assert text == blocks.table_block(one, [r for r in made() if r["seed"] == 0]) and "seed 0;" in text[-1]


def test_a_seed_that_few_scenes_have_is_on_no_scene() -> None:
    seeds = replace(GROUP, rows=(replace(Row("a"), seeds=2), *GROUP.rows[2:]))
    with_more = [*made(), record("a", SCENES[0], 99.0, seed=1)]
    assert blocks.scenes_block(seeds, with_more)[:-1] == blocks.scenes_block(seeds, made())[:-1]


def test_other_code_commits_and_changes_are_named() -> None:
    def last(**changes: Any) -> str:
        return blocks.table_block(
            GROUP, [*(r for r in made() if r["row"] != "b"), *(record("b", s, 33, **changes) for s in SCENES)]
        )[-1]

    assert "code differs" not in last()
    other = last(commit="decade000000")
    assert other.startswith("Commits c0ffee000000, decade000000;") and "code differs" not in other
    other = last(commit="decade000000", code="ffffffffffff")
    assert (
        "**The methods' code differs**: c0ffee000000: `spike4dgs-x`, `a`, `tfp+stg`, `c`; decade000000: `b`." in other
    )
    assert last(dirty=True).startswith("Commits c0ffee000000, c0ffee000000 with changes;")
    assert "A processor, 2 cores and Another" in last(cpu="Another")


def test_rows_with_networks_are_compared_with_those_of_the_same_weights_alone() -> None:
    rows = ("tfp+stg", "spk2img+stg", "spk2img+4dgs", "spike4dgs-x", "spike4dgs")
    group = replace(GROUP, rows=tuple(map(Row, rows)))

    codes = {"spk2img+stg": "00000000000c", "spk2img+4dgs": "00000000000c", "spike4dgs": "00000000000d"}

    def last(changed: str = "", **changes: str) -> str:
        each = [record(row, s, 30) for row in rows for s in SCENES]
        each = [r | {"code": codes.get(r["row"], r["code"])} for r in each]
        return blocks.table_block(group, [r | changes if r["row"] == changed else r for r in each])[-1]

    assert "code differs" not in last() and "code differs" in last("spk2img+4dgs", code="00000000000e")
    assert "code differs" in last("spike4dgs", commit="decade000000"), "neither digests nor commits are equal"


def test_cells_of_other_budgets_splits_and_scenes_are_not_of_the_table() -> None:
    changes = ({"budget": 4.0}, {"split": "corner"}, {"scene": "car-0-small"}, {"row": "else"})
    assert blocks.table_block(GROUP, [{**record("a", SCENES[0], 30), **c} for c in changes]) == [blocks.NOTHING]


@pytest.mark.parametrize("name", BLOCKS)
def test_every_block_says_that_there_is_nothing_yet_and_shows_what_there_is(name: str) -> None:
    assert BLOCKS[name]([]) == [blocks.NOTHING]
    of = {
        "breaks": ON_CONDITIONS,
        "cameras": replace(TRACK_SMALL, scenes=(*TRACK_SMALL.scenes, *blocks.NINE.scenes)),
        "conditions": ON_CONDITIONS,
        "content": CONTENT,
        "covisible": TRACK_SMALL,
        "modality": ON_SENSORS,
        "modality-noisy": NOISY,
        "paper": PAPER,
        "parts": PARTS,
        "realistic": TRACK_SMALL,
        "steps": STEPS[0],
        "table2": TABLE2,
    }
    scenes = of.get(name.removesuffix("-scenes"), blocks.NINE).scenes
    rows = SHOWN.get(name, ("spike4dgs-x", "tfp+rig-flat+stg"))
    split = {"split": "views-3"} if name == "table5" else {}
    text = "\n".join(BLOCKS[name]([record(row, s, 30 + k, **split) for row in rows for k, s in enumerate(scenes)]))
    assert all(f"`{row.removesuffix('.images')}`" in text for row in rows) and "c0ffee000000" in text


def test_the_order_of_the_paper_stands_beside_ours_for_complete_rows_of_both():
    """The paper's means have tfp+4dgs before tfp+stg before tfp+d3dgs: of three pairs, ours here agree in two."""
    ours = {"tfp+4dgs": 34.0, "tfp+stg": 35.0, "tfp+d3dgs": 31.0, "spike4dgs-x": 40.0}
    found = [record(row, s, value) for row, value in ours.items() for s in TABLE1.scenes]
    found += [record("tfi+stg", TABLE1.scenes[0], 39.0)]
    lines = published_block(TABLE1, 1, found)
    assert lines[2:6] == [
        "| `spike4dgs-x` | 40.00 | 42.00 |  |  | 0.9700 |  |  |",
        "| `tfp+stg` | 35.00 | 37.00 | 24.91 | 1 / 2 | 0.9700 | 0.8512 | 1 / 2 |",
        "| `tfp+4dgs` | 34.00 | 36.00 | 26.39 | 2 / 1 | 0.9700 | 0.8868 | 1 / 1 |",
        "| `tfp+d3dgs` | 31.00 | 33.00 | 20.36 | 3 / 3 | 0.9700 | 0.7688 | 1 / 3 |",
    ]
    assert lines[7].startswith(f"Kendall's tau with the published order: PSNR {(2 - 1) / 3:.2f}")
    assert "20 of 50 planned cells" in lines[9], "of the rows that are shown, three of them with three seeds"


def test_estimated_poses_stand_beside_given_ones_where_both_are_measured():
    rows = {"tfp+stg": 30.0, "tfp+colmap+stg": 29.5, "spike4dgs": 34.0, "spike4dgs-uncalibrated": 33.75}
    found = [record(row, s, value) for row, value in rows.items() for s in TABLE1.scenes]
    found += [record("tfi+colmap+stg", s, 28.0) for s in TABLE1.scenes]
    assert unposed_block(found)[2:5] == [
        "| `spike4dgs-uncalibrated` | 35.75 / 33.75 | 0.9700 | `spike4dgs` | -0.25 / -0.25 |",
        "| `tfp+colmap+stg` | 31.50 / 29.50 | 0.9700 | `tfp+stg` | -0.50 / -0.50 |",
        "| `tfi+colmap+stg` | 30.00 / 28.00 | 0.9700 | `tfi+stg` | - |",
    ]
    others = [record("spike4dgs", s, 50.0, seed=1) for s in TABLE1.scenes]
    given = [{**r, "commit": "decade000000"} if r["row"] == "tfp+stg" else r for r in [*found, *others]]
    assert unposed_block(given)[2:5] == unposed_block(found)[2:5], "the same seed beside"
    assert unposed_block(given)[-1].startswith("Commits c0ffee000000, decade000000;")


@pytest.mark.parametrize(
    ("given", "estimated", "changes", "marked"),
    [
        ("tfp+stg", "tfp+colmap+stg", {"commit": "decade000000"}, False),
        ("tfp+stg", "tfp+colmap+stg", {"code": "00000000000c"}, True),
        ("spike4dgs-x", "spike4dgs-x+colmap", {"code": "00000000000c"}, False),  # one covers the baselines
        ("spike4dgs-x", "spike4dgs-x+colmap", {"code": "00000000000c", "commit": "decade000000"}, True),
        ("spike4dgs", "spike4dgs-uncalibrated", {"code": "00000000000c"}, False),  # of other networks
    ],
)
def test_other_code_of_the_row_with_given_poses_is_marked(
    given: str, estimated: str, changes: dict[str, str], marked: bool
) -> None:
    found = [record(given, s, 30.0) for s in TABLE1.scenes]
    line, _, legend, *_ = unposed_block([*found, *(record(estimated, s, 29.0, **changes) for s in TABLE1.scenes)])[2:]
    assert line.endswith(f"| -1.00 / -1.00{'†' * marked} |") and ("different code" in legend) is marked


def test_table_5_has_a_column_for_each_number_of_views():
    found = [record("spike4dgs", "turntable-0-small", 30.0 + n, split=f"views-{n}") for n in (3, 4, 8)]
    lines = views_block([*found, record("spike4dgs", "turntable-0-small", 50.0)])
    assert lines[0] == "| training views | 3 | 4 | 5 | 6 | 7 | 8 |"
    assert lines[2] == "| `spike4dgs` | 35.00 / 33.00 | 36.00 / 34.00 | - | - | - | 40.00 / 38.00 |"


def test_pairs_count_the_scenes_on_which_the_first_is_ahead():
    found = [record("tfp+stg", s, 30.0 + k) for k, s in enumerate(blocks.NINE.scenes)]
    found += [record("tfp+4dgs", s, 32.0 + 0.5 * k) for k, s in enumerate(blocks.NINE.scenes)]
    lines = pairs_block(found)
    assert lines[2] == "| `tfp+stg` | `tfp+4dgs` | +0.00 | 4 | +0.00 | 4 |"
    assert "18 of 54 planned cells" in lines[-1], "of the rows that are shown"


def test_a_condition_has_its_own_scenes_and_shows_what_it_changes_where_both_worlds_are_measured():
    own = [c for c in CONDITIONS if not c.refined and c.split == "center"]
    assert len(ON_CONDITIONS.scenes) == sum(len(condition.worlds) for condition in own)
    assert "car-1-small-reset-read-dead" in ON_CONDITIONS.scenes and "turntable-2-small" in ON_CONDITIONS.scenes
    first, lens, blur = (condition.scenes for condition in CONDITIONS[:3])
    found = [record(OURS, s, 30.0 + k) for k, s in enumerate(first)]
    found += [record(OURS, s, 29.0 - k) for k, s in enumerate(lens)]
    found += [record(OURS, blur[0], 25.0), record("tfp+stg", first[0], 25.0)]
    found += [record("truth.noise", s, 53.0) for s in lens]
    lines = conditions_block(found)
    assert lines[2] == "| none |  | 32.50 / 30.50 | - |", "no column for a row with one world"
    assert lines[3].endswith("| -2.00 / -2.00 | 55.00 / 53.00 |") and not lines[4], (
        "the blur has been measured in one world"
    )
    assert "6 of" in lines[-1]


def test_a_change_between_two_codes_of_a_row_is_marked() -> None:
    first, lens, _ = (condition.scenes for condition in CONDITIONS[:3])
    before = [record(OURS, s, 30.0) for s in first]
    line, legend = (conditions_block([*before, *(record(OURS, s, 29.0) for s in lens)])[k] for k in (3, 5))
    assert "| -1.00 / -1.00 |" in line and "†" not in legend
    other = [record(OURS, s, 29.0, code="00000000000c") for s in lens]
    line, legend = (conditions_block([*before, *other])[k] for k in (3, 5))
    assert "| -1.00 / -1.00† |" in line and "†: the two were measured with different code" in legend


def test_other_code_is_marked_in_the_tables_beside_conditions_too() -> None:
    first, lens = (condition.scenes for condition in CONDITIONS[:2])
    dim = next(c for c in CONDITIONS if c.name == "light 1/4").scenes
    own = [record(OURS, s, 40.0) for s in (*first, *TRACK_SMALL.scenes)]
    for code, mark in (("00000000000b", ""), ("00000000000c", "†")):
        found = [*own, *(record(OURS, s, 35.0, code=code) for s in (*lens, *dim))]
        broken, covisible = breaks_block(found), covisible_block(found)
        assert any(f"| 1/4 / 1/4{mark} |" in line for line in broken) and f"lens, known (`{OURS}`{mark})" in broken[-1]
        assert f"| `{OURS}`, lens, known | -5.00{mark} | -5.00{mark} |  |  |" in covisible
        assert all(("†: the two were" in "".join(lines)) is bool(mark) for lines in (broken, covisible))


def test_a_condition_that_was_made_in_one_world_is_compared_with_that_world():
    moves = next(c for c in CONDITIONS if "--array-motion" in c.options)
    assert moves.worlds == ("car-1",) and moves.name.endswith("car-1 alone")
    found = [record(OURS, s, psnr) for s, psnr in zip(CONDITIONS[0].scenes, (30.0, 50.0), strict=True)]
    found += [record(OURS, moves.scenes[0], 28.0)]
    assert conditions_block(found)[3].endswith("| `--array-motion 2` `--array-rotation 60` | -2.00 / -2.00 | - |")


def test_what_breaks_a_row_is_the_mildest_amount_that_costs_three_decibels():
    """Of light: 1/4 costs 2.9 dB, 1/16 costs 3.1; more light none. One world counts against itself alone."""
    losses = {"none": 0.0, "light 1/4": 2.9, "light 1/16": 3.1, "light times 2": 0.0}
    found = [record(OURS, s, 40.0 - losses[c.name]) for c in CONDITIONS if c.name in losses for s in c.scenes]
    alone = next(c for c in CONDITIONS if c.ms == 500)
    found += [record(OURS, s, 36.5) for s in alone.scenes]
    lines = breaks_block(found)
    cells = {(line.split(" | ")[0], line.split(" | ")[1]): line.split(" | ")[2] for line in lines[2:8]}
    assert cells["| light", "1/4, 1/16, 1/64"] == "1/16 / 1/16"
    assert cells["| light", "2"] == "no / no"
    assert cells["| length of the clip, ms", "100, 500"] == "500 / 500"
    assert cells["| speed", "2, 4"] == "-"
    assert "Of the other conditions, none costs a row as much." in lines[-1]
    lens = next(c for c in CONDITIONS if c.name.startswith("lens"))
    lines = breaks_block([*found, *(record(OURS, s, 30.0) for s in lens.scenes)])
    assert f"Of the other conditions, lens, known (`{OURS}`) costs a row as much." in lines[-1]


def test_pages_say_whether_all_values_are_finite_and_how_many_cells_failed():
    found = [record(OURS, s, 30.0) for s in CONDITIONS[0].scenes]
    assert "planned cells, all finite. " in conditions_block(found)[-1]
    found[0] = with_finite(found[0] | {"metrics": {"psnr": float("nan")}})
    failed = record("tfp+stg", CONDITIONS[0].scenes[0], 30.0) | {"error": "no points", "metrics": {}}
    assert " cells, 1 not finite, and 1 that failed." in conditions_block([*found, failed])[-1]


def test_noise_of_frames_and_events_is_compared_with_the_same_scene_without():
    (scene,) = NOISY.scenes
    found = [record("edi+stg", scene, 28.0), record("edi+stg", scene.removesuffix("-others"), 30.0)]
    assert noisy_block([*found, record("edi+4dgs", scene, 26.0)])[2:4] == [
        "| `edi+stg` | 32.00 / 30.00 | -2.00 / -2.00 |",
        "| `edi+4dgs` | - | - |",
    ]


def test_fewer_cameras_are_a_condition_of_the_undisturbed_scenes():
    first = CONDITIONS[0].scenes
    found = [record(OURS, s, 30.0, split=split) for s in first for split in ("center", "views-3", "views-5", "views-4")]
    found = [r | {"metrics": r["metrics"] | {"psnr": 22.0}} if r["split"] == "views-3" else r for r in found]
    lines = conditions_block(found)
    assert lines[3:5] == [
        "| 5 of 8 cameras | `run-benchmark --split views-5` | +0.00 / +0.00 | - |",
        "| 3 of 8 cameras | `run-benchmark --split views-3` | -10.00 / +0.00 | - |",
    ]
    assert [(v.name, v.scenes) for v in VIEWS] == [("conditions-views-5", first), ("conditions-views-3", first)]
    assert "6 of" in lines[-1], "four of eight cameras are no condition of the plan"


def test_conditions_say_how_much_depends_on_the_seed():
    """Variances of 1 and 3 dB^2 in two scenes are a deviation of the root of 2; one seed says nothing."""
    one, other, alone = ON_CONDITIONS.scenes[:3]
    found = [record(OURS, one, 30.0 + k, seed=k) for k in range(3)] + [record(OURS, alone, 99.0)]
    found += [record(OURS, other, 40.0 + np.sqrt(3) * k, seed=k) for k in range(3)]
    sentence = f"With 3 seeds of `{OURS}` a scene's values have a standard deviation of 1.41 / 1.41 dB."
    assert conditions_block(found)[-3].endswith(sentence)
    assert "seeds of" not in "".join(conditions_block([*found[:1], *found[3:5]]))


def test_a_condition_with_refined_held_out_poses_has_the_scores_of_the_refined_row():
    first, poses = CONDITIONS[0], next(c for c in CONDITIONS if "--pose-noise" in c.options and not c.refined)
    refined = next(c for c in CONDITIONS if c.refined)
    assert refined.scenes == poses.scenes == REFINED.scenes
    assert [row.name for row in REFINED.rows] == [f"{row.name}.refined" for row in ON_CONDITIONS.rows]
    found = [record(OURS, s, 30.0) for s in first.scenes] + [record(OURS, s, 28.5) for s in poses.scenes]
    found += [record(f"{OURS}.refined", s, 29.75) for s in poses.scenes]
    lines = conditions_block(found)
    assert [line.split(" | ")[2] for line in lines[3:5]] == ["-1.50 / -1.50", "-0.25 / -0.25"]


def test_what_few_cameras_see_is_told_by_its_difference_and_between_seeds():
    """Seeds move the whole image by 2 dB on every other scene, co-visible pixels nowhere: deviations of 1 and 0."""

    def cell(row: str, scene: str, value: float, covisible: float | None, seed: int = 0) -> dict[str, Any]:
        known = {} if covisible is None else {"psnr_covisible": covisible}
        return record(row, scene, value, seed) | {"metrics": {"psnr": value, "psnr_dynamic": value, **known}}

    scenes = TRACK_SMALL.scenes[:2]
    found = [cell(OURS, s, 30 + 2 * k * seed, 33, seed) for k, s in enumerate(scenes) for seed in (0, 1)]
    found += [cell("tfp+stg", s, 25, 25.5) for s in scenes] + [cell("spike4dgs", scenes[0], 25, 25.5)]
    found += [cell("spk2img+stg", s, 25, None) for s in scenes]
    none, lens, blur = CONDITIONS[:3]
    found += [cell(OURS, s, value, 40) for c, value in ((none, 40), (lens, 39)) for s in c.scenes]
    found += [cell(OURS, s, 38, None) for s in blur.scenes]
    assert covisible_block(found)[2:6] == [
        f"| `{OURS}`, 2 scenes | 30.50 | 33.00 | 1.00 | 0.00 |",
        "| `tfp+stg`, 2 scenes | 25.00 | 25.50 | - | - |",
        f"| `{OURS}`, lens, known | -1.00 | +0.00 |  |  |",
        "",
    ]


def test_hard_content_has_a_column_for_each_world():
    found = [
        record(OURS, "mirror-1-small", 30.0),
        record(OURS, "flash-1-small", 25.0),
        record("c", "flash-1-small", 1.0),
        record("truth.noise", "blank-1-small", 52.0),
    ]
    lines = content_block(found)
    assert lines[0] == "| row | appear | beads | blank | flash | mirror | rain |"
    assert lines[2:5] == [
        f"| `{OURS}` | - | - | - | 27.00 / 25.00 | 32.00 / 30.00 | - |",
        "| noise of the truth | - | - | 54.00 / 52.00 | - | - | - |",
        "",
    ]


def test_images_stand_beside_the_papers_order_as_they_are_and_corrected():
    """The paper has TFI below TFP below MSDI; here TFP is last, so one of three pairs disagrees: tau 1/3."""
    ours = {"tfi": 27.0, "tfp": 26.0, "msdi": 31.0, "ssml": 29.0}
    found = [record(f"{m}.images", s, value, render_fps=200.0) for m, value in ours.items() for s in TABLE6.scenes]
    found += [record("tfp+rig-flat.images", s, 33.0) for s in TABLE6.scenes]
    found += [record("tfp+shading.images", s, 30.0) for s in TABLE6.scenes]
    found += [record("adaptive.images", TABLE6.scenes[0], 40.0)]
    lines, nothing = images_block(found), "- | - | - | -"
    assert lines[2:6] == [
        f"| `msdi` | 5 | 33.00 / 31.00 | 0.9700 | {nothing} | MSDI's images | 34.90 / 0.961 |",
        f"| `ssml` | 5 | 31.00 / 29.00 | 0.9700 | {nothing} |  |  |",
        f"| `tfi` | 5 | 29.00 / 27.00 | 0.9700 | {nothing} | TFI | 24.51 / 0.850 |",
        "| `tfp` | 5 | 28.00 / 26.00 | 0.9700 | 32.00 / 30.00 | 0.9700 | 35.00 / 33.00 | 0.9700 "
        "| TFP | 25.37 / 0.852 |",
    ]
    assert lines[7].startswith("Kendall's tau with the published order of PSNR: 0.33. Means of 9 scenes;")
    assert images_block([record("tfp.images", s, 26.0, quiet=False, render_fps=200.0) for s in TABLE6.scenes])[
        2
    ].startswith("| `tfp` | (5) |")


def test_sensors_are_ranked_where_things_move_beside_the_bits_they_send(tmp_path: Path) -> None:
    bits = {"spike4dgs-x": 5e8, "rgb+stg": 1.2e7, "edi+stg": 8.6e7}
    moving = {"spike4dgs-x": 38.0, "rgb+stg": 25.0, "edi+stg": 31.0}
    found = [
        record(row, scene, moving[row] + k, bits_per_second=bits[row])
        for row in bits
        for k, scene in enumerate(ON_SENSORS.scenes)
    ]
    found.append(record("rgb+4dgs", ON_SENSORS.scenes[0], 50.0))
    lines = modality_block(found)
    assert [line.split(" | ")[:5] for line in lines[2:5]] == [
        ["| 1", "`spike4dgs-x`", "spikes", "500", "42.00"],
        ["| 2", "`edi+stg`", "frames and events", "86", "35.00"],
        ["| 3", "`rgb+stg`", "frames", "12", "29.00"],
    ]
    assert "| 7.00 ± 0.00 |" in lines[3] and "28 of 90 planned cells" in lines[-1]
    older = [{k: v for k, v in r.items() if k != "bits_per_second"} if r["row"] == "rgb+stg" else r for r in found]
    assert modality_block(older)[4].split(" | ")[:5] == ["| 3", "`rgb+stg`", "frames", "-", "29.00"]
    plot_modality(tmp_path / "modality.png", older)
    with Image.open(tmp_path / "modality.png") as image:
        assert np.asarray(image.convert("L")).std() > 10


def test_what_ours_reaches_on_each_scene_and_in_the_mean():
    found = [record(OURS, scene, 30.0 + k, seed) for k, scene in enumerate(blocks.NINE.scenes) for seed in (0, 1)]
    lines = own_scenes_block([*found, record("a", blocks.NINE.scenes[0], 50.0)])
    assert lines[2] == "| jaywalk | 32.00 | 0.9700 | 30.00 | 0.9600 | 0.050 | - |"
    assert lines[11] == "| **mean** | 36.00 | 0.9700 | 34.00 | 0.9600 | 0.050 | - |"
    assert "18 of 27 planned cells" in lines[-1]


@pytest.mark.parametrize("count", [1, 2])
def test_few_scenes_tell_no_ranks_and_no_lead(count: int) -> None:
    """A record has one value a scene: nothing says how much it varies."""
    group = replace(GROUP, scenes=SCENES[:count])
    found = [record("a", scene, 30.0) for scene in group.scenes] + [record(OURS, s, 35.0) for s in group.scenes]
    lines = blocks.table_block(group, found)
    assert lines[4].startswith(f"| 1-2 | `{OURS}` |") and lines[5].startswith("| 1-2 | `a` | 30.00 | 5.00 |")
    assert "even with `a` where things move (5.00 dB)" in blocks.lead_block(group, found)[2]


def test_what_the_missing_flat_fields_cost_on_each_scene_and_in_the_mean():
    scenes, without = blocks.NINE.scenes, "spike4dgs-x+self-calibrated"
    found = [record(OURS, scene, 30.0 + k, seed) for k, scene in enumerate(scenes) for seed in (0, 1)]
    assert self_calibrated_block(found) == [blocks.NOTHING]
    found += [record(without, scene, 29.0 + k / 2) for k, scene in enumerate(scenes)]
    lines = self_calibrated_block(found)
    assert lines[2] == "| jaywalk | 32.00 / 30.00 | 31.00 / 29.00 | -1.00 / -1.00 |"
    assert lines[11] == "| **mean** | 36.00 / 34.00 | 33.00 / 31.00 | -3.00 / -3.00 |"
    assert "27 of 54 planned cells" in lines[-1]


def test_the_realistic_cameras_table_is_of_the_scenes_that_were_measured():
    scenes = track_scenes("small", ["car", "van", "jaywalk"])
    found = [record(OURS, scene, 40.0 + k) for k, scene in enumerate(scenes)]
    found += [record("tfp+rig-flat+stg", scene, 30.0) for scene in (*scenes, "bird-0-small-realistic")]
    found += [record("spike4dgs", scene, 35.0) for scene in scenes[1:]]
    lines = realistic_block(found)
    assert lines[0].endswith("Means of 9 scenes.")
    assert [line.split(" | ")[:3] for line in lines[4:6]] == [
        ["| 1", "`spike4dgs-x`", "44.00"],
        ["| 2", "`tfp+rig-flat+stg`", "30.00"],
    ]
    assert "Incomplete, not ranked: `spike4dgs` (8 of 9 scenes)." in lines


def test_cameras_are_compared_on_the_same_worlds():
    worlds = ("car", "van")
    realistic = [scene for scene in track_scenes("small", worlds) if "-0-" in scene]
    found = [record(OURS, scene, 40.0 + k) for k, scene in enumerate(realistic)]
    found += [record(OURS, scene, 38.0) for scene in track_scenes("ideal", (*worlds, "bird"))]
    found.append(record(OURS, "car-3-small-realistic", 0.0))  # the ideal camera has no such variant
    found += [record("tfp+stg", scene, 30.0) for scene in realistic]  # never before the ideal one
    lines = cameras_block(found)
    assert lines[2] == f"| `{OURS}` | 40.00 / 38.00 | 42.50 / 40.50 | +2.50 / +2.50 |"
    assert lines[3] == "" and "the same 2 worlds" in lines[4]


def test_the_papers_size_beside_the_papers_times():
    """Over the scenes that ours was tried on; rows that lack one of these, or failed on it, are named below."""
    scenes = track_scenes("paper", ["car", "van", "bird"])
    found = [record("tfp+4dgs", scene, 31.0, fit_seconds=1500.0, render_fps=10.0, quiet=False) for scene in scenes]
    found += [record(OURS, scene, 40.0 + k, fit_seconds=120.0, render_fps=200.0) for k, scene in enumerate(scenes[:2])]
    found.append(record("spike4dgs", scenes[0], 39.0))
    found = [r | {"peak_memory_mb": 2040.0} for r in found]
    lines = paper_block(found)
    assert lines[2:4] == [
        f"| `{OURS}` | 40.50 | 42.50 | 0.9700 | 0.050 | 120 | 0.10 | 200 | 5.00 | 2.0 |",
        "| `tfp+4dgs` | 31.00 | 33.00 | 0.9700 | 0.050 | (1500) | (1.25) | (10) | (0.25) | 2.0 |",
    ]
    assert lines[4:7] == ["", "Incomplete, not ranked: `spike4dgs` (1 of 2 scenes).", ""]
    assert lines[7].startswith("Means of 2 scenes: car-0-paper, van-0-paper.")
    failed = paper_block([*found, record(OURS, scenes[2], 0.0, error="no weights", metrics={})])
    assert failed[2].startswith("| `tfp+4dgs` |") and failed[3] == "", "ours has no mean"
    assert f"`{OURS}` (2 of 3 scenes; bird-0-paper, seed 0: no weights)" in failed[4]


def test_a_part_is_worth_what_its_absence_costs():
    off = f"{OURS}[{SWITCHES['coherence of motion']}]"
    found = [record(OURS, scene, 40.0 + k) for k, scene in enumerate(PARTS.scenes)]
    found += [record(off, scene, 39.5 + 2 * k) for k, scene in enumerate(PARTS.scenes)]
    lines = parts_block(found)
    assert lines[2].endswith("| 42.00 / 40.00 | 43.00 / 41.00 | 44.00 / 42.00 | 43.00 / 41.00 |")
    (coherence,) = (line for line in lines if line.startswith("| coherence"))
    assert coherence == (
        "| coherence of motion | `motion.coherence=0` | -0.50 / -0.50 | +0.50 / +0.50 | +1.50 / +1.50 | +0.50 / +0.50 |"
    )
    other = [r | {"code": "00000000000c"} if r["row"] == off else r for r in found]
    assert "| +0.50 / +0.50† |" in "".join(marked := parts_block(other)) and "different code" in marked[-3]


def test_more_steps_stand_beside_a_rows_own():
    gains = {1.0: 0, 4.0: 1.5, 16.0: 2}
    found = [record("tfp+stg", s, 30.0 + gain, budget=b) for b, gain in gains.items() for s in STEPS[0].scenes]
    found += [record("tfp+4dgs", s, 31.0) for s in STEPS[0].scenes]
    lines = steps_block(found)
    assert "| `tfp+stg` | 32.00 / 30.00 | +1.50 / +1.50 | +2.00 / +2.00 |" in lines
    assert "| `tfp+4dgs` | 33.00 / 31.00 | - | - |" in lines
    assert "budgets quick, standard, 16; 12 of 81 planned" in lines[-1]
    fewer = steps_block([r for r in found if r["budget"] < 16])
    assert "| `tfp+stg` | 32.00 / 30.00 | +1.50 / +1.50 |" in fewer, "a number of steps without any cell has no column"


def test_every_part_is_switched_off_by_settings_that_change_the_recipe():
    plain, *without = (get_method(row.name).params["settings"] for row in PARTS.rows)
    assert all(settings != plain for settings in without)
