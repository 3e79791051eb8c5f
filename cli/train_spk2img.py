"""`train-spk2img`: train the network of the spk2img images on training variants of the worlds."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import OmitArgPrefixes

from spike4dgs.baselines.images.spk2img.train import Training, TrainingSettings, open_for_training, read_examples, run
from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.errors import problem
from spike4dgs.cli.options import COMPUTE, Compute


def train_spk2img(
    *,
    scenes: tuple[Path, ...],
    hidden: tuple[Path, ...] = (),
    out: Path = Path("runs/spk2img"),
    width: int = 8,
    steps: int = 20_000,
    compute: OmitArgPrefixes[Compute] = COMPUTE,
    allow_gaps: bool = False,
) -> int:
    """Train Spk2ImgNet on training variants of the worlds. A killed run goes on where it was with the same command.

    OUT/spk2img-WIDTH.safetensors can be used at any time: set SPIKE4DGS_SPK2IMG to its path. The public benchmark's
    scenes, variant 0, are refused.

    Args:
        scenes: Scene folders to train on.
        hidden: Scene folders that are only scored, while training and at its end.
        out: Folder for the weights and the checkpoint.
        width: Channels; 64 is the publication's (a GPU's work), 8 the shipped weights'.
        steps: Steps of 8 patches of 48x48 pixels (smaller ones where images are smaller).
        allow_gaps: Accept recordings with gaps; images whose spikes lack ticks are not trained on.
    """
    if width < 1 or steps < 1:
        raise problem("--width and --steps", "numbers from 1 up", f"{width}, {steps}", "correct them")
    opened, kept = ([open_for_training(s, allow_gaps) for s in folders] for folders in (scenes, hidden))
    if both := {s.revision for s in opened} & {s.revision for s in kept}:
        found = ", ".join(s.id for s in kept if s.revision in both)
        raise problem("--hidden", "scenes that are not trained on", found, "name them once")
    examples = [example for scene in opened for example in read_examples(scene)]
    if not examples:
        raise problem("--scenes", "scene folders", "none", "make some with `spike4dgs make-dataset --variant 1`")
    shortest = min(min(example.rate.shape) for example in examples)
    settings = TrainingSettings(width=width, steps=steps, patch=min(TrainingSettings.patch, shortest))
    training = Training(examples, settings, choose_device(compute.device, rasterizes=False), compute.seed)
    names = tuple(sorted(f"{s.id}@{s.revision[:16]}" for s in opened))
    print(f"{len(examples)} images of {len(opened)} scenes, width {width}, {training.device}", flush=True)
    run(training, kept, names, out)
    return 0
