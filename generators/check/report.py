"""The report of a check: check.md, check.json, and a picture of where the truths differ."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.files import write_json, write_text
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import Scene, Target
from spike4dgs.generators.check.differences import Float64, images_of, truth_error
from spike4dgs.generators.check.verdict import Comparison

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
