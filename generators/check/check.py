"""The check of made scenes against a reference, such as a release.

A scene whose revision is another one is rendered once more, with other noise of the rendering and nothing else changed.
That scene, OUT/.noise/ID, says how much noise alone changes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.generators.check.differences import difference
from spike4dgs.generators.check.facts import differing_facts
from spike4dgs.generators.check.report import Trio, write_picture, write_report
from spike4dgs.generators.check.verdict import CHANGE, EQUAL, Comparison
from spike4dgs.generators.profiles import Job

Make = Callable[[Job, Path], None]  # make a scene below a folder, unless it is there

NOISE_FOLDER = ".noise"


def find_references(reference: Path, ids: Sequence[str]) -> dict[str, Scene]:
    """Return the reference scenes by id: `reference` is a folder of scene folders, or one of them.

    Raises UserError where one is missing or damaged.
    """
    found = {}
    for name in ids:
        folder = reference if (reference / "scene.json").is_file() else reference / name
        if not folder.is_dir():
            raise problem(
                folder, f"the reference scene {name}", "no such folder", "download it, or leave the world out"
            )
        scene = open_scene(folder, allow_gaps=True)
        if scene.id != name:
            raise problem(folder, f"the reference scene {name}", f"scene {scene.id}", "name its world and profile")
        found[name] = scene
    return found


def check_scenes(jobs: Sequence[Job], out: Path, references: Mapping[str, Scene], make: Make) -> int:
    """Compare made scenes with their references; write OUT/check.md, check.json and check.png, and print the verdicts.

    Return 0 where every scene is equal or differs by noise, and 1 otherwise.
    """
    comparisons: list[Comparison] = []
    scenes: list[Trio] = []
    for job in jobs:
        made, reference = open_scene(out / job.id, allow_gaps=True), references[job.id]
        comparison, noise = _compare(job, out, made, reference, make)
        comparisons.append(comparison)
        if comparison.verdict != EQUAL:
            scenes.append((made, reference, noise))
        print(f"{job.id}: {comparison.verdict}", *(f"  {reason}" for reason in comparison.reasons), sep="\n")
    write_report(out, comparisons)
    write_picture(out / "check.png", scenes)
    print(f"report: {out / 'check.md'}")
    return int(any(c.verdict == CHANGE for c in comparisons))


def _compare(job: Job, out: Path, made: Scene, reference: Scene, make: Make) -> tuple[Comparison, Scene | None]:
    revisions = made.revision, reference.revision
    if revisions[0] == revisions[1]:
        return Comparison(job.id, *revisions), None
    facts = differing_facts(made, reference)
    shapes = [(s.n_ticks, {c.id: (c.width, c.height) for c in s.cameras.values()}) for s in (made, reference)]
    if shapes[0] != shapes[1]:
        return Comparison(job.id, *revisions, facts), None
    make(replace(job, noise=1), out / NOISE_FOLDER)
    noise = open_scene(out / NOISE_FOLDER / job.id, allow_gaps=True)
    found = {camera: difference(made, reference, camera) for camera in made.cameras}
    floor = {camera: difference(made, noise, camera) for camera in made.cameras}
    return Comparison(job.id, *revisions, facts, found, floor), noise
