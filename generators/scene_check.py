"""The check of made scenes against a reference, such as a release: equal, rendering noise, or a change of the world.

A scene whose revision is another one is rendered once more, with other noise of the rendering and nothing else changed.
That scene, OUT/.noise/ID/REVISION/ID, gives the floor of this revision: what differs from the reference as much as from
it differs by noise.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import write_json, write_text
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.generators.profiles import Job
from spike4dgs.generators.scene_differences import Difference, difference, differing_facts, images_of, truth_error

EQUAL, NOISE, CHANGE = "equal", "rendering noise", "change of the world"
# The most that a difference may be of that between two noises. Between Mitsuba's variants the measures of a camera were
# 0.90 to 1.06 times that (car-0-tiny), those of blocks over all cameras 0.80 to 1.59: few blocks are noisy.
MOST_OF_CAMERA = {"bits": 1.25, "truth_rms": 1.5}
MOST_OF_ALL = {
    "spikes_block_rms": 1.75,
    "truth_block_rms": 1.75,
    "spikes_block_max": 2.5,
    "truth_block_max": 2.5,
    "masks": 2.5,
}
MEANING = {
    "bits": "spike bits",
    "truth_rms": "truths",
    "spikes_block_rms": "spikes per tick in blocks",
    "truth_block_rms": "truths in blocks",
    "spikes_block_max": "spikes per tick in the worst block",
    "truth_block_max": "truths in the worst block",
    "masks": "masks",
}
_ROUNDING = 1e-6  # of white, or of the bits
# Masks have specks of changed light that one noise makes and another does not: up to 1.6e-3 of the pixels of a camera
# of jaywalk-0-tiny, and none in others.
_NEGLIGIBLE = {"masks": 2e-3}


@dataclass(frozen=True)
class Comparison:
    """A made scene, its reference, and what differs; `noise` is the floor of `found`, by camera."""

    scene: str
    revision: str
    reference_revision: str
    facts: Sequence[str] = ()
    found: Mapping[str, Difference] = field(default_factory=dict)
    noise: Mapping[str, Difference] = field(default_factory=dict)

    @property
    def reasons(self) -> list[str]:
        """What noise does not explain."""
        return [*self.facts, *beyond_noise(self.found, self.noise)]

    @property
    def verdict(self) -> str:
        """EQUAL, NOISE or CHANGE."""
        if self.revision == self.reference_revision:
            return EQUAL
        return CHANGE if self.reasons else NOISE

    @property
    def record(self) -> dict[str, Any]:
        """The comparison as JSON."""
        cameras = {
            camera: {"found": d.record, "noise": self.noise[camera].record if camera in self.noise else None}
            for camera, d in self.found.items()
        }
        revisions = {"revision": self.revision, "reference_revision": self.reference_revision}
        return {"scene": self.scene, "verdict": self.verdict, **revisions, "reasons": self.reasons, "cameras": cameras}


def beyond_noise(found: Mapping[str, Difference], noise: Mapping[str, Difference]) -> list[str]:
    """Return one line for each measure by which the cameras of `noise` differ more than noise explains."""
    lines = []
    for camera in noise:
        lines += _beyond(camera, MOST_OF_CAMERA, _values([found[camera]]), _values([noise[camera]]))
    all_found, all_noise = _values([found[camera] for camera in noise]), _values(list(noise.values()))
    return lines + _beyond("all cameras", MOST_OF_ALL, all_found, all_noise)


def _values(differences: Sequence[Difference]) -> dict[str, float]:
    """Return each measure over several cameras: the largest `_max`, of others the RMS."""
    values = {}
    for name in MEANING:
        if own := [value for d in differences if (value := getattr(d, name)) is not None]:
            values[name] = max(own) if name.endswith("_max") else math.sqrt(sum(v * v for v in own) / len(own))
    return values


def _beyond(where: str, most: Mapping[str, float], found: Mapping[str, float], noise: Mapping[str, float]) -> list[str]:
    lines = []
    for name in most.keys() & found.keys() & noise.keys():
        if found[name] > max(most[name] * noise[name], _NEGLIGIBLE.get(name, _ROUNDING)):
            times = f"{found[name] / noise[name]:.3g} times as much as" if noise[name] else "and not"
            lines.append(f"{where}: {MEANING[name]} differ {times} by noise; up to {most[name]:g} times is noise")
    return sorted(lines)


SCHEMA = "spike4dgs-check/1"
Trio = tuple[Scene, Scene, Scene | None]  # made, reference, other noise

_MEANINGS = {
    "equal": "The data are the same: scores compare.",
    "rendering noise": "The same world, rendered with other noise: valid data, but scores do not compare.",
    "change of the world": "Something other than noise differs.",
}


def write_report(out: Path, comparisons: Sequence[Comparison]) -> None:
    """Write OUT/check.json and OUT/check.md."""
    write_json(out / "check.json", {"schema": SCHEMA, "scenes": [c.record for c in comparisons]})
    write_text(out / "check.md", to_markdown(comparisons))


def to_markdown(comparisons: Sequence[Comparison]) -> str:
    """Return the report as Markdown: the verdicts, then the figures of every camera beside those of noise."""
    lines = [
        "# Check of scenes against a reference",
        "",
        "| scene | verdict | revision | reference |",
        "|---|---|---|---|",
    ]
    lines += [f"| {c.scene} | {c.verdict} | {c.revision[:16]} | {c.reference_revision[:16]} |" for c in comparisons]
    for c in comparisons:
        lines += ["", f"## {c.scene}: {c.verdict}", "", _MEANINGS[c.verdict]]
        lines += ["", *(f"- {reason}" for reason in c.reasons)] if c.reasons else []
        lines += ["", *_table(c)] if c.found else []
    return "\n".join(lines) + "\n"


def _table(c: Comparison) -> list[str]:
    heads = ["camera", "spike bits that differ", "by noise", "truth, dB", "by noise", "truth in blocks", "by noise"]
    heads += ["spikes in blocks", "by noise"]
    rows = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for camera, found in c.found.items():
        noise = c.noise.get(camera)
        cells = [camera]
        for name, unit in (("bits", "%"), ("truth_db", "dB"), ("truth_block_rms", ""), ("spikes_block_rms", "")):
            cells += [_cell(getattr(d, name) if d else None, unit) for d in (found, noise)]
        rows.append("| " + " | ".join(cells) + " |")
    rows += ["", "Blocks are 8x8 pixels, of spikes also 100 ticks: RMS of the differences of their means, white is 1."]
    return rows


def _cell(value: float | None, unit: str) -> str:
    if value is None:
        return "-"
    return f"{value:.3%}" if unit == "%" else f"{value:.1f}" if unit == "dB" else f"{value:.2e}"


def write_picture(path: Path, scenes: Sequence[Trio]) -> None:
    """Write where the truths differ: the worst image of each scene, and the same difference by noise, on one scale."""
    rows = [(trio, worst) for trio in scenes if (worst := worst_image(trio[0], trio[1]))]
    if not rows:
        return
    figure = new_figure((12, 2.6 * len(rows)))
    for axes, ((made, reference, noise), target) in zip(
        figure.subplots(len(rows), 4, squeeze=False), rows, strict=True
    ):
        errors = [truth_error(made, other, target) if other else None for other in (reference, noise)]
        scale = max(_scale(error) for error in errors)
        for ax, (title, scene) in zip(axes, (("made", made), ("reference", reference)), strict=False):
            ax.imshow(encode_srgb(scene.ground_truth(target)), cmap="gray", vmin=0, vmax=255)
            ax.set_title(f"{title}: {made.id}, {target.name}", fontsize=8)
        for ax, (title, error) in zip(
            axes[2:], zip(("made - reference", "by noise"), errors, strict=True), strict=True
        ):
            if error is not None:
                shown = ax.imshow(error, cmap="RdBu_r", vmin=-scale, vmax=scale, interpolation="nearest")
                figure.colorbar(shown, ax=ax, shrink=0.8)
            ax.set_title(title, fontsize=8)
        for ax in axes:
            ax.set(xticks=[], yticks=[])
    save_figure(figure, path)


def worst_image(made: Scene, reference: Scene) -> Target | None:
    """Return the image whose truths differ most (RMS); None where no image is in both scenes."""
    found = [
        (float(np.sqrt(np.mean(error**2))), target)
        for camera in made.cameras
        for target in images_of(made, camera)
        if (error := truth_error(made, reference, target)) is not None
    ]
    return max(found)[1] if found else None


def _scale(error: Float64 | None) -> float:
    return 1e-6 if error is None else max(float(np.percentile(np.abs(error), 99.5)), 1e-6)


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
    folder = out / NOISE_FOLDER / job.id / made.revision[:16]
    if not folder.is_dir():  # what is there instead is the noise of a scene that was made again since
        shutil.rmtree(folder.parent, ignore_errors=True)
    make(replace(job, noise=1), folder)
    noise = open_scene(folder / job.id, allow_gaps=True)
    found = {camera: difference(made, reference, camera) for camera in made.cameras}
    floor = {camera: difference(made, noise, camera) for camera in made.cameras}
    return Comparison(job.id, *revisions, facts, found, floor), noise
