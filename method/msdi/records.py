"""What a training leaves beside its weights: the curves of its course, its shards, and the model card."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.environment import harness
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path, read_json, write_json, write_text
from spike4dgs.benchmark.scene.training_bursts import BurstFacts, BurstFile
from spike4dgs.benchmark.variants import HIDDEN_VARIANTS
from spike4dgs.method.msdi.config import CONFIGS
from spike4dgs.method.msdi.losses import TrainingSettings
from spike4dgs.method.msdi.weights import VARIABLE, Card

Row = Mapping[str, float]


@dataclass(frozen=True)
class StartWeights:
    """The weights that a training began with."""

    name: str  # of the file
    sha256: str
    shards: Set[str] = frozenset()  # that they were trained on, as ID@SHA256
    steps: int = 0  # of their training, where it was one of ours


class Curve:
    """Rows by step in a CSV file; those that a resumed training will make again are dropped.

    Raises UserError for a file that is no such table.
    """

    def __init__(self, path: Path, until_step: int) -> None:
        self.path = path
        self.rows: list[dict[str, float]] = []
        if path.is_file():
            try:
                with open(path, newline="") as f:
                    found = csv.DictReader(f)
                    rows = [{name: float(value) for name, value in row.items() if value != ""} for row in found]
                self.rows = [row for row in rows if row["step"] <= until_step]
            except (ValueError, KeyError, TypeError) as e:
                raise problem(path, "a table of numbers", f"damaged text ({e})", "delete it") from None

    def add(self, step: int, values: Row) -> None:
        """Add a row, in place of those from that step on: a finished training may score its weights again."""
        self.rows = [*(row for row in self.rows if row["step"] < step), {"step": step, **values}]

    def write(self) -> None:
        """Write the file."""
        # Rows may have further columns, once there are shards to score.
        text, names = io.StringIO(), dict.fromkeys(["step", *(name for row in self.rows for name in row)])
        writer = csv.DictWriter(text, list(names), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: f"{value:.7g}" for name, value in row.items()} for row in self.rows)
        write_text(self.path, text.getvalue())


def note_shards(path: Path, files: Sequence[BurstFile], earlier: Set[str], *, fresh: bool) -> tuple[str, ...]:
    """Return the training's shards as ID@SHA256, with the `earlier` ones of its weights and those of its other starts.

    They are kept in a file.
    """
    names = {f"{f.facts.id}@{f.sha256[:16]}" for f in files} | earlier
    if path.is_file() and not fresh:
        names |= set(read_json(path, "what was trained on")["shards"])
    write_json(path, {"shards": sorted(names)})
    return tuple(sorted(names))


def plot_curves(path: Path, losses: Sequence[Row], scores: Sequence[Row]) -> None:
    """Plot the training's losses, and the scores on hidden variants."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 7), layout="constrained")
    panels = (
        (losses, ("image_l1",), "L1 of images (radiance)", True),
        (losses, ("points",), "loss of points", False),
        (scores, ("psnr_db", "tfp_psnr_db", "psnr_dynamic_db", "tfp_psnr_dynamic_db"), "PSNR, hidden (dB)", False),
        (scores, ("point_error", "point_error_median", "point_error_confident"), "error of points, hidden", True),
        (scores, ("rotation_deg", "direction_deg"), "error of poses, hidden, median (degrees)", True),
        (scores, ("confidence_rank", "calibration"), "confidence, hidden", False),
    )
    for axes, (rows, names, title, logarithmic) in zip(figure.subplots(2, 3).flat, panels, strict=True):
        for name in names:
            points = [(row["step"], row[name]) for row in rows if name in row]
            axes.plot(*zip(*points, strict=True) if points else ((), ()), ".-", markersize=3, label=name)
        axes.set(title=title, xlabel="step", yscale="log" if logarithmic else "linear")
        axes.grid(True, color="0.9")
        axes.legend(fontsize=8)
    with atomic_path(path) as part:
        figure.savefig(part)


def plot_calibration(path: Path, groups: Float64) -> None:
    """Plot the true against the expected error of groups [G, 2] of pixels."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 5), layout="constrained")
    axes = figure.subplots()
    ends = [float(groups.min()), float(groups.max())]
    axes.plot(ends, ends, color="0.7", label="as expected")
    axes.plot(groups[:, 0], groups[:, 1], "o-", label="tenths of the pixels, by expected error")
    axes.set(xscale="log", yscale="log", xlabel="expected error, alpha / C", ylabel="true error")
    axes.set_title("points of hidden variants,\nin mean distances of a sample")
    axes.grid(True, color="0.9")
    axes.legend(fontsize=8)
    with atomic_path(path) as part:
        figure.savefig(part)


_ROWS = {  # name in `evaluate` -> text of the card
    "psnr_db": "images, sensors known: PSNR (dB)",
    "raw_psnr_db": "images, sensors unknown: PSNR (dB)",
    "tfp_psnr_db": "the mean of the same spikes (tfp): PSNR (dB)",
    "tfp_flat_psnr_db": "tfp, corrected for the sensors: PSNR (dB)",
    "psnr_dynamic_db": "images, sensors known, moving region: PSNR (dB)",
    "raw_psnr_dynamic_db": "images, sensors unknown, moving region: PSNR (dB)",
    "tfp_psnr_dynamic_db": "tfp, moving region: PSNR (dB)",
    "tfp_flat_psnr_dynamic_db": "tfp, corrected, moving region: PSNR (dB)",
    "point_error": "points: mean error, in mean distances of a sample",
    "point_error_median": "points: median error",
    "point_error_confident": "points: mean error of the half that is most certain",
    "confidence_rank": "confidence: rank correlation of expected and true error",
    "calibration": "confidence: mean abs. logarithm of true over expected error, ten groups",
    "rotation_deg": "poses before refinement: median rotation error (degrees)",
    "direction_deg": "poses before refinement: median error of the direction to the camera (degrees)",
    "rra_5": "poses: share of rotations within 5 degrees",
    "rta_5": "poses: share of directions within 5 degrees",
    "posed": "poses: share of the views that have one",
}


def data_commands(facts: Sequence[BurstFacts]) -> list[str]:
    """Return the commands that make the training shards of these facts: one for all that have the same settings."""
    worlds: dict[str, Counter[str]] = {}
    for f in facts:
        named = {"rigs": f.rigs, "instants": f.instants, "resting": f.resting, "width": f.width, "height": f.height}
        settings = " ".join(f"--{name} {value}" for name, value in {**named, "spp": f.spp, "seed": f.seed}.items())
        worlds.setdefault(settings, Counter())[f.world] += 1
    return [
        f"spike4dgs make-msdi-data {' '.join(sorted(found))} --variants {max(found.values())} {settings}"
        for settings, found in sorted(worlds.items())
    ]


def model_card(
    card: Card, settings: TrainingSettings, sha256: str, facts: Sequence[BurstFacts], start: StartWeights | None = None
) -> str:
    """Return the text of the card, in Markdown.

    `sha256` is that of the weight file, `facts` those of the training shards.
    """
    config = CONFIGS[card.config]
    worlds = Counter(name.rpartition("-")[0] for name in {name.rpartition("@")[0] for name in card.trained_on})
    variants = ", ".join(f"{world} ({count})" for world, count in sorted(worlds.items()))
    command = f"spike4dgs train-msdi --config {card.config} --steps {settings.steps} --views {settings.views}"
    command += f" --rate {settings.lr_points:g} --seed {card.seed}"
    command += f" --start {start.name}" if start else ""
    most = min(settings.most_views, settings.views)
    earlier = f" of step {start.steps}" if start and start.steps else ""
    began = f"Begun with the weights `{start.name}`{earlier}, sha256 `{start.sha256}`. " if start else ""
    steps = card.steps - (start.steps if start else 0)
    commands = "\n".join(f"  `{line}`," for line in data_commands(facts))
    return f"""# Model card: MSDI, configuration `{card.config}`

MSDI takes {config.ticks} ticks of spikes from two or more cameras. It returns an image for each camera, and the point
that each pixel sees, in the first camera's frame, with a confidence. PnP on these points gives the cameras' poses.

Weights of step {card.steps}, as half floats, sha256 `{sha256}`.
`{VARIABLE}=FILE` uses other weights of the same format.

{_measured(card, settings)}## Training

- Data: bursts rendered by `make-msdi-data`; variants of each world: {variants}. Variants 0 to 9 are never rendered
  for training, nor is any world's own rig. Spikes are simulated anew at every use, with random sensors, brightness,
  views and direction of time, and mirrored half of the time.
- Loss: L1 of radiance for extractor and generator, DUSt3R's confidence-weighted regression of points for the rest.
- {steps} steps of {settings.views} views in total, 2 to {most} per sample; Adam at
  {settings.lr_points:g} ({settings.lr_images:g} for extractor and generator) after {settings.warm_up} steps of warm-up,
  falling to 0 along a cosine over {settings.steps} steps; gradients of both clipped at norm 1; seed {card.seed}. In
  {settings.unknown_share:.0%} of the steps the intrinsics are withheld, in {settings.raw_share:.0%} the sensors.
- {began}Commit {harness()["commit"] or "unknown"}. Commands:
{commands}
  then `{command}`.
  On other machines the numbers differ in their last digits.

## Limits

- The worlds and the sensor are simulated, and the variants of a world resemble each other. The training data contain no
  scenes of another kind and no recordings of real cameras.
- The training data contain one kind of sensor: gain, noise and spread between pixels are those of the simulated
  cameras.
- Points have no absolute scale.
"""


def _measured(card: Card, settings: TrainingSettings) -> str:
    """Return the part of the card that says how good the weights are; empty where there was nothing to score."""
    rows = [f"| {text} | {card.measured[name]:g} |" for name, text in _ROWS.items() if name in card.measured]
    if not rows:
        return ""
    numbers = ", ".join(map(str, HIDDEN_VARIANTS))
    return f"""## Measured on hidden variants

Variants {numbers} of each world, in up to {settings.most_views} views, seen by rigs that were not used in training.
Intrinsics are known, and so are the sensors unless a row says otherwise. A view without a pose counts as 180 degrees.
Next to this card, `calibration.png` plots expected against true errors, and `curves.png` shows the training.

| measured | value |
|---|---|
{chr(10).join(rows)}

"""
