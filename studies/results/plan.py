"""What the sweep measures: groups of scenes and rows, in the order in which their cells are fitted.

A row's name is a method's. What a row was tuned on is a fact of its history, and stands here; what it is given follows
from its recipe (`knowledge_of`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from spike4dgs.baselines import recipes as theirs
from spike4dgs.benchmark.method import DEFAULT_BUDGET, DEFAULT_GIVEN, Method
from spike4dgs.benchmark.reports.paper_tables import PublishedTable, published
from spike4dgs.generators.physics import CAMERAS
from spike4dgs.generators.profiles import TRACKS
from spike4dgs.method import recipes as ours
from spike4dgs.method.tuned import SUFFIX as TUNED

CALIBRATED, UNCALIBRATED = "calibrated", "uncalibrated"
KNOWLEDGE = {  # the blocks of a table, in their order -> what its rows are given
    CALIBRATED: "given the poses, and each camera's flat field and dark recording",
    UNCALIBRATED: "given the poses alone",
}

# What a row's numbers were chosen on. Public variants are those that tables report.
OUR_TRIALS = "release 1, variants 0"
# Velocities, fast motion and dim light were judged on variants 10; what tells a moving array, on bricks too.
X_TRIALS = f"{OUR_TRIALS}, development variants 10, and bricks-0-small of the track ideal"
FEW_TRIALS = "release 1, variants 0, few trials"  # motions of other people: steps for the budget, rates to match
NOT_TUNED = "not tuned"
CEILING = "truth.noise"  # the row of the scores that the truth's noise allows


@dataclass(frozen=True)
class Row:
    """A row of tables: a method, how many seeds it is fitted with, and what it was tuned on. `ours`: it may lead."""

    name: str
    seeds: int = 1
    tuned_on: str = FEW_TRIALS
    ours: bool = False


@dataclass(frozen=True)
class Group:
    """Rows on scenes, with a budget and a split."""

    name: str
    title: str
    scenes: tuple[str, ...]
    rows: tuple[Row, ...]
    budget: str = DEFAULT_BUDGET
    split: str = "center"


@dataclass(frozen=True)
class Cell:
    """A fit of the plan: a row on a scene with a seed."""

    row: str
    scene: str
    seed: int
    budget: str
    split: str
    tuned_on: str = field(compare=False)


def track_scenes(track: str, worlds: Iterable[str]) -> tuple[str, ...]:
    """Return the ids of a track's scenes of some worlds, as `make-dataset --track` names them.

    >>> track_scenes("ideal", ["car", "van"])
    ('car-0-small', 'van-0-small')
    >>> track_scenes("dev-small", ["car"])
    ('car-10-small-realistic', 'car-11-small-realistic')
    """
    made = TRACKS[track]
    suffix = CAMERAS[made.camera].suffix
    return tuple(f"{world}-{variant}-{made.profile}{suffix}" for world in worlds for variant in made.variants)


# The most important first: what a reader compares with, then what is far behind or costs most.
ROWS = (
    Row("spike4dgs-x", 3, X_TRIALS, ours=True),
    Row("tfp+rig-flat+stg", 3),
    Row("tfp+stg", 3),
    Row("tfp+4dgs", 3),
    Row("spk2img+stg", 3),
    Row("spike4dgs", 3, OUR_TRIALS, ours=True),
    Row("adaptive+rig-flat+stg", 3),
    Row("tfp+rig-flat+4dgs", 3),
    Row("spk2img+rig-flat+stg", 3),
    Row("spike4dgs-x+self-calibrated", 3, X_TRIALS, ours=True),
    Row("adaptive+rig-flat+4dgs"),
    Row("spk2img+rig-flat+4dgs"),
    Row("tfi+rig-flat+stg"),
    Row("tfi+rig-flat+4dgs"),
    Row("spk2img+4dgs"),
    Row("tfi+stg"),
    Row("tfi+4dgs"),
    Row("dy-spikegs"),
    Row("tfp+rig-flat+d3dgs"),
    Row("spk2img+rig-flat+d3dgs"),
    Row("adaptive+rig-flat+d3dgs"),
    Row("tfi+rig-flat+d3dgs"),
    Row("tfp+d3dgs"),
    Row("spk2img+d3dgs"),
    Row("tfi+d3dgs"),
    Row("nearest-view", tuned_on=NOT_TUNED),
    Row("tfp+static"),
    Row("dy-spikenerf"),
    # Networks with their authors' weights, which a user fetches.
    *(Row(f"{images}+stg") for images in ("ssml", "ssir", "spikeclip", "scflow-tfp")),
    *(Row(f"{images}+4dgs") for images in ("ssml", "ssir", "spikeclip", "scflow-tfp")),
)


def tuned_rows() -> tuple[Row, ...]:
    """Return the rows X.tuned that there are, in the order of X, with as many seeds."""
    searched = {**theirs.SEARCHES, **ours.SEARCHES}
    return tuple(
        replace(row, name=f"{row.name}{TUNED}", tuned_on=f"{', '.join(found['scenes'])}, {found['trials']} trials")
        for row in ROWS
        if (found := searched.get(row.name))
    )


# Tuned rows come first: what a reader compares with. Then the rows as their publications have them.
ALL_ROWS = (*tuned_rows(), *ROWS)
TABLE1 = Group("table1", "Table 1: outdoor scenes", track_scenes("ideal", published(1).worlds), ALL_ROWS)
TABLE2 = Group("table2", "Table 2: objects", track_scenes("ideal", published(2).worlds), ALL_ROWS)
PLAN = (TABLE1, TABLE2)  # the main tables; see also `ABLATIONS` and `tables`


def ablation(name: str, table: PublishedTable, scenes: tuple[str, ...], split: str = "center") -> Group:
    """Return the group of a table of the paper with one seed. Rows that need DUSt3R's checkpoint are left out."""
    return Group(name, table.title, scenes, once(row for row in table.rows if "dust3r" not in row), split=split)


def once(names: Iterable[str]) -> tuple[Row, ...]:
    """Return rows with one seed, as the main tables have them and others too."""
    known = {row.name: replace(row, seeds=1) for row in ALL_ROWS}
    return tuple(known.get(name) or Row(name, tuned_on=_tuned_on(name)) for name in names)


def _tuned_on(row: str) -> str:
    """Return what a row of ablations was tuned on: as ours where it is one of ours, with COLMAP's poses too."""
    if row.replace("+colmap", "") not in ours.METHODS:
        return FEW_TRIALS
    return X_TRIALS if row.startswith("spike4dgs-x") else OUR_TRIALS


# The paper's smaller tables, and table 1 without given poses.
TABLE3, TABLE4, TABLE7 = (ablation(f"table{n}", published(n), TABLE1.scenes) for n in (3, 4, 7))
UNPOSED = ablation("unposed", published(1, "estimated"), TABLE1.scenes)
TURNTABLE = track_scenes("ideal", published(5).worlds)
TABLE5 = tuple(ablation(split, published(5), TURNTABLE, split) for split in published(5).splits)
ABLATIONS = (TABLE3, TABLE4, TABLE7, UNPOSED, *TABLE5)

# For trials of the machinery: seconds a cell. No page shows it.
TRIAL = Group(
    "trial",
    "Two tiny scenes",
    ("car-0-tiny", "turntable-0-tiny"),
    (Row("nearest-view", 2, NOT_TUNED), Row("tfp+stg"), Row("tfp+rig-flat+stg"), Row("spike4dgs-x", 2, X_TRIALS)),
    budget="0.1",
)


def cells_of(groups: Sequence[Group]) -> list[Cell]:
    """Return the cells of groups, each once, in the order in which they are fitted.

    First comes seed 0 of every row, row by row, each over all scenes of all groups that have it.
    """
    found: dict[Cell, tuple[int, int]] = {}
    for group in groups:
        for place, row in enumerate(group.rows):
            for seed in range(row.seeds):
                for scene in group.scenes:
                    cell = Cell(row.name, scene, seed, group.budget, group.split, row.tuned_on)
                    found.setdefault(cell, (seed, place))
    return sorted(found, key=found.__getitem__)


def knowledge_of(method: Method) -> str:
    """Return the block of tables that a method belongs to, by what it is given of a scene."""
    return CALIBRATED if "flat-field" in getattr(method, "given", DEFAULT_GIVEN) else UNCALIBRATED
