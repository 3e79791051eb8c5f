"""What each condition of camera and light costs a row: the same two worlds with and without it. And hard content.

Its cells are a group of the sweep's plan. No row was tuned on these variants, which move as fast as the public ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import tyro

from spike4dgs.benchmark.runs.refinement import SUFFIX
from spike4dgs.benchmark.scene.splits import DEFAULT_SPLIT
from spike4dgs.generators.physics import PhysicsOptions
from spike4dgs.generators.worlds import HARD
from spike4dgs.studies.kit.timing import markdown
from spike4dgs.studies.results.blocks import NOTHING, both_text, of_group, provenance, psnr_texts
from spike4dgs.studies.results.changes import change_text, legend_of
from spike4dgs.studies.results.comparison import BOTH, MeasuredRow, rows_of
from spike4dgs.studies.results.plan import CEILING, NOT_TUNED, OUR_TRIALS, X_TRIALS, Group, Row
from spike4dgs.studies.results.records import Record
from spike4dgs.studies.results.tables.ceilings import ceiling_row

WORLDS = ("car-1", "turntable-2")


@dataclass(frozen=True)
class Condition:
    """A condition, and the options of `make-dataset` that make it. `refined`: scored at the fitted held-out pose.

    `split` is the scene's: some cameras of the array alone. `worlds` are those that it was made with.
    """

    name: str
    physics: str = ""
    ms: int | None = None  # the clip's length, if not that of the profile
    refined: bool = False
    split: str = DEFAULT_SPLIT
    worlds: tuple[str, ...] = WORLDS

    @property
    def options(self) -> str:
        """The options of `make-dataset`, or of `run-benchmark` where cameras are left out."""
        if self.split != DEFAULT_SPLIT:
            return f"run-benchmark --split {self.split}"
        return self.physics if self.ms is None else f"{self.physics} --seconds {self.ms / 1000:g}".strip()

    @cached_property
    def scenes(self) -> tuple[str, ...]:
        """The ids of its scenes, one for each world."""
        suffix = tyro.cli(PhysicsOptions, args=self.physics.split()).physics().suffix
        return tuple(f"{world}-small{'' if self.ms is None else f'-{self.ms}ms'}{suffix}" for world in self.worlds)

    @cached_property
    def absent(self) -> Condition:
        """No condition, in the same worlds."""
        return replace(NONE, worlds=self.worlds)


NONE = Condition("none")
CONDITIONS = (
    NONE,
    Condition("lens, known", "--lens -0.2 0.03 --lens-spread 0.5"),
    Condition("blur of 0.5 px", "--psf-px 0.5"),
    Condition("poses 0.1 px off", "--pose-noise-deg 0.025"),
    Condition("the same, held-out pose refined", "--pose-noise-deg 0.025", refined=True),
    Condition("flicker of 8 %", "--flicker 0.08"),
    Condition("dark rate doubled", "--warming-k 8"),
    Condition("reset and read noise, dead tick", "--reset-noise 0.0009 --read-noise 0.006 --dead-ticks 1"),
    Condition("5 % of ticks lost", "--lost-ticks 0.05"),
    Condition("realistic camera", "--camera realistic"),
    Condition("light 1/4", "--light 0.25"),
    Condition("light 1/16", "--light 0.0625"),
    Condition("light 1/64", "--light 0.015625"),
    Condition("light times 2", "--light 2"),
    Condition("twice as fast", "--speed 2"),
    Condition("four times as fast", "--speed 4"),
    Condition("5 ms", ms=5),
    Condition("100 ms, turntable-2 alone", ms=100, worlds=("turntable-2",)),
    Condition("500 ms, car-1 alone", ms=500, worlds=("car-1",)),
    Condition("5 of 8 cameras", split="views-5"),
    Condition("3 of 8 cameras", split="views-3"),
    Condition("the array moves, car-1 alone", "--array-motion 2 --array-rotation 60", worlds=("car-1",)),
)
GROUP = Group(
    "conditions",
    "Conditions of camera and light",
    tuple(dict.fromkeys(scene for condition in CONDITIONS for scene in condition.scenes)),
    (
        Row("spike4dgs-x", 3, X_TRIALS, ours=True),
        Row("tfp+rig-flat+stg"),
        Row("spike4dgs", 1, OUR_TRIALS, ours=True),
        Row("spk2img+stg"),
        Row("tfp+stg"),
        Row("tfp+4dgs"),
    ),
)
REFINED = Group(
    "conditions-refined",
    "Conditions, held-out poses refined",
    tuple(scene for condition in CONDITIONS if condition.refined for scene in condition.scenes),
    tuple(replace(row, name=f"{row.name}{SUFFIX}") for row in GROUP.rows),
)
VIEWS = tuple(
    replace(GROUP, name=f"conditions-{condition.split}", scenes=condition.scenes, split=condition.split)
    for condition in CONDITIONS
    if condition.split != DEFAULT_SPLIT
)
EVERY = (GROUP, REFINED, *VIEWS)
CONTENT = Group("content", "Hard content", tuple(f"{world}-1-small" for world in HARD), GROUP.rows)
CEILINGS = Group("ceilings", "Noise of the truth", (*GROUP.scenes, *CONTENT.scenes), (Row(CEILING, 1, NOT_TUNED),))
_NOISE = "noise of the truth"


def conditions_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of the table: PSNR without a condition, and what each one changes, in dB, by row.

    Left out are conditions that no row was measured under in all their worlds, and rows that were not measured without
    one.
    """
    own = of_conditions(records)
    if not own:
        return [NOTHING]
    first = [row for row in rows_under([row.name for row in GROUP.rows], NONE, own) if row.is_complete]
    names = [row.name for row in first]
    lines = [[NONE.name, "", *map(both_text, first), _ceiling(NONE, records)]]
    for condition in CONDITIONS[1:]:
        rows, without = (rows_under(names, c, own) for c in (condition, condition.absent))
        if any(row.is_complete for row in rows):
            changes = map(change_text, rows, without)
            lines.append([condition.name, _code(condition.options), *changes, _ceiling(condition, records)])
    heads = ("condition", "options of `make-dataset`", *(f"`{name}`" for name in names), _NOISE)
    legend = (
        f"Whole image / where things move, dB; means of {' and '.join(WORLDS)}. The first row lists PSNR, the "
        f"others its change; a prediction without error has the PSNR of the {_NOISE}, measured at the middle target."
    )
    text = " ".join([legend_of(legend, lines), *_seeds(names, own)])
    return [*markdown(heads, lines), "", text, "", provenance(own, *EVERY)]


def of_conditions(records: Sequence[Record]) -> list[Record]:
    """Return the records of all conditions."""
    return [record for group in EVERY for record in of_group(group, records)]


def _code(options: str) -> str:
    # Options of `make-dataset` are code each, so that a narrow column breaks between them.
    return f"`{options.replace(' --', '` `--') if options.startswith('--') else options}`"


def _ceiling(condition: Condition, records: Sequence[Record]) -> str:
    return both_text(ceiling_row(condition.scenes, records))


def _seeds(names: Sequence[str], own: Sequence[Record]) -> list[str]:
    """Return a sentence for each row with several seeds: how far they move a scene's values, pooled over scenes."""
    sentences, own = [], of_group(GROUP, own)
    for name in names:
        rows = [row for scene in GROUP.scenes for row in rows_of([name], (scene,), own) if len(row.seeds) > 1]
        found = [[row.variance(metric) for metric in BOTH] for row in rows]
        variances = [[v for v in pair if v is not None] for pair in found if None not in pair]
        if variances:
            deviations = " / ".join(f"{d:.2f}" for d in np.sqrt(np.mean(variances, axis=0)))
            seeds = max(len(row.seeds) for row in rows)
            sentences.append(
                f"With {seeds} seeds of `{name}` a scene's values have a standard deviation of {deviations} dB."
            )
    return sentences


def rows_under(names: Sequence[str], condition: Condition, records: Sequence[Record]) -> list[MeasuredRow]:
    """Return rows on a condition's scenes and split, those with refined held-out poses where it asks for them."""
    suffix = SUFFIX if condition.refined else ""
    own = [record for record in records if record["split"] == condition.split]
    return rows_of([f"{name}{suffix}" for name in names], condition.scenes, own)


def content_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of the scenes with hard content: PSNR of the whole image and where things move, by row."""
    own = of_group(CONTENT, records)
    rows = [row for row in rows_of([row.name for row in CONTENT.rows], CONTENT.scenes, own) if row.cells]
    if not rows:
        return [NOTHING]
    lines = [[f"`{row.name}`", *(psnr_texts(row, scene) for scene in CONTENT.scenes)] for row in rows]
    lines += [[_NOISE, *(psnr_texts(ceiling_row((scene,), records), scene) for scene in CONTENT.scenes)]]
    legend = f"PSNR of the whole image / where things move, dB. A prediction without error has that of the {_NOISE}."
    return [*markdown(("row", *HARD), lines), "", legend, "", provenance(own, CONTENT)]
