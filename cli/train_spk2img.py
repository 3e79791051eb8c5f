"""`train-spk2img`: train Spk2ImgNet on training variants of the worlds."""

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
    """Train Spk2ImgNet on training variants of the worlds. The same command resumes a killed run where it stopped.

    OUT/spk2img-WIDTH.safetensors can be used at any time: set SPIKE4DGS_SPK2IMG to its path. Variants that are kept for
    scores are refused: the public benchmark's (0, 3 and 4), 10 to 12, and hidden seasons' from 9000 on.

    Args:
        scenes: Scene folders to train on.
        hidden: Scene folders that are only scored, during training and at its end.
        out: Folder for the weights and the checkpoint.
        width: Channels; 64 in the publication (for a GPU), 8 in the shipped weights.
        steps: Number of steps, each of 8 patches of 48x48 pixels (smaller if images are smaller).
        allow_gaps: Accept recordings with gaps; images with missing ticks are not used.
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
