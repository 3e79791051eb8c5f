"""The model card that a training writes beside its weights."""

from __future__ import annotations

from collections import Counter

from spike4dgs.benchmark.environment import harness
from spike4dgs.benchmark.variants import HIDDEN_VARIANTS
from spike4dgs.method.msdi.config import CONFIGS
from spike4dgs.method.msdi.training.settings import TrainingSettings
from spike4dgs.method.msdi.weights import VARIABLE, Card

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


def model_card(card: Card, settings: TrainingSettings, sha256: str) -> str:
    """Return the text of the card, in Markdown; `sha256` is that of the weight file."""
    config = CONFIGS[card.config]
    worlds = Counter(name.rpartition("@")[0].rpartition("-")[0] for name in card.trained_on)
    variants = ", ".join(f"{world} ({count})" for world, count in sorted(worlds.items()))
    rows = [f"| {text} | {card.measured[name]:g} |" for name, text in _ROWS.items() if name in card.measured]
    numbers = ", ".join(map(str, HIDDEN_VARIANTS))
    command = f"spike4dgs train-msdi --config {card.config} --steps {settings.steps} --views {settings.views}"
    command += f" --rate {settings.lr_points:g} --seed {card.seed}"
    return f"""# Model card: MSDI, configuration `{card.config}`

MSDI takes {config.ticks} ticks of spikes of two or more cameras. It gives an image of each camera, the point that each
pixel sees in the first camera's frame, with a confidence, and, by PnP, the cameras' poses.

Weights of step {card.steps}, as half floats, sha256 `{sha256}`.
`{VARIABLE}=FILE` uses other weights of the same format.

## Measured on hidden variants

Variants {numbers} of each world, seen by rigs that were not used in training. Intrinsics are known, and so are the
sensors unless a row says otherwise; up to {settings.most_views} views. A view without a pose counts as 180 degrees.
Beside this card, `calibration.png` plots expected against true errors, and `curves.png` the training.

| measured | value |
|---|---|
{chr(10).join(rows)}

## Training

- Data: bursts rendered by `make-msdi-data`; variants of each world: {variants}. Variants 0 to 9 are never rendered
  for training, nor is any world's own rig. Spikes are simulated anew at every use, with random sensors, brightness,
  views and direction of time, and mirrored half of the time.
- Loss: L1 of radiance for extractor and generator, DUSt3R's confidence-weighted regression of points for the rest.
- {card.steps} steps of {settings.views} views in all, 2 to {settings.most_views} of a sample; Adam at
  {settings.lr_points:g} ({settings.lr_images:g} for extractor and generator) after {settings.warm_up} steps of warm-up,
  falling to 0 with the cosine over {settings.steps} steps; gradients of both clipped at norm 1; seed {card.seed}. In
  {settings.unknown_share:.0%} of the steps the intrinsics are withheld, in {settings.raw_share:.0%} the sensors.
- Commit {harness()["commit"] or "unknown"}. Commands:
  `spike4dgs make-msdi-data --variants {max(worlds.values())}`, then `{command}`.
  On other machines the numbers differ in their last digits.

## Limits

- The worlds and the sensor are simulated, and the variants of a world resemble each other. The training data contain no
  scenes of another kind and no recordings of real cameras.
- The training data contain one kind of sensor: gain, noise and spread between pixels are those of the simulated
  cameras.
- Points have no absolute scale.
"""
