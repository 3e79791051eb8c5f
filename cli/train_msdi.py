"""`train-msdi`: train the network that estimates points, poses and images from spikes."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import OmitArgPrefixes

from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import sha256_file, write_text
from spike4dgs.benchmark.scene.training_bursts import BurstFile
from spike4dgs.cli.options import COMPUTE, Compute, check_names
from spike4dgs.method.image_network.config import CONFIGS as IMAGE_NETWORKS
from spike4dgs.method.image_network.config import ImageTraining
from spike4dgs.method.image_network.training import train as image_training
from spike4dgs.method.image_network.training.evaluate import evaluate, table
from spike4dgs.method.matching.config import CONFIGS as MATCHERS
from spike4dgs.method.matching.config import MatcherTraining
from spike4dgs.method.matching.training.train import MatchTraining, run, training_key
from spike4dgs.method.msdi.config import CONFIGS
from spike4dgs.method.msdi.losses import PUBLISHED, TrainingSettings
from spike4dgs.method.msdi.train import Run, Training, checkpoint_key, start_from, training_shards
from spike4dgs.method.msdi.training_data import Bursts


def train_msdi(
    *,
    data: Path = Path("data/msdi"),
    out: Path = Path("runs/msdi"),
    config: str = "small",
    start: Path | None = None,
    steps: int = 20_000,
    views: int = 8,
    rate: float = PUBLISHED["lr_points"],
    compute: OmitArgPrefixes[Compute] = COMPUTE,
) -> int:
    """Train MSDI on bursts of `make-msdi-data`. The same command resumes a killed run where it stopped.

    OUT/msdi-CONFIG.safetensors can be used at any time: set SPIKE4DGS_MSDI to its path. OUT/losses.csv, scores.csv and
    curves.png show the progress, calibration.png how well the confidence is calibrated; README.md is the model card.
    Shards added to DATA are used from the next start on.

    Args:
        data: Folder of shards; those of the hidden variants are only scored.
        out: Folder for all output.
        config: small, paper (for a GPU), bottleneck (the network that matches views: it uses only data, out, start,
            steps and seed, and a larger --steps continues where the training ended), images (the network that makes
            images: it uses only data, out, start, steps, seed and device), or an ablation of the latter
            (images-without-spikes, -error-bar, -windows, -beside, -sensor, or -moving-loss).
        start: Weights to start from: an earlier training's, or, for paper, Fast3R's or DUSt3R's published file. For
            bottleneck, their steps count towards --steps; the others train for --steps more, on other batches.
        steps: Number of steps.
        views: Total number of views per step: samples times views per sample (2 to 8).
        rate: Adam's learning rate, after the warm-up, for the layers that predict points.
    """
    check_names("--config", [config], (*CONFIGS, *MATCHERS, *IMAGE_NETWORKS))
    if steps < 1 or views < 2 or not rate > 0:
        found = f"{steps}, {views} and {rate}"
        raise problem("--steps, --views and --rate", "at least 1, 2 and more than 0", found, "correct them")
    learned, hidden = training_shards(data)
    if config in MATCHERS:
        return _train_matcher(learned, config, start, steps, compute.seed, out)
    device = choose_device(compute.device, rasterizes=False)
    if config in IMAGE_NETWORKS:
        return _train_images((learned, hidden), config, start, steps, device, compute.seed, out)
    settings = TrainingSettings(steps=steps, views=views, lr_points=rate, warm_up=min(500, max(1, steps // 10)))
    training = Training(Bursts(learned), CONFIGS[config], settings, device, compute.seed)
    begun = start_from(training.network, start) if start else None
    key = checkpoint_key(settings, config, compute.seed, begun.sha256 if begun else None)
    size = sum(p.numel() for p in training.network.parameters())
    print(f"{len(training.data)} bursts, {config}, {size / 1e6:.1f} M parameters, {training.device}", flush=True)
    Run(training, hidden, key, out, begun).run()
    return 0


def _train_matcher(files: list[BurstFile], config: str, start: Path | None, steps: int, seed: int, out: Path) -> int:
    settings = MatcherTraining()
    training = MatchTraining(files, MATCHERS[config], settings, seed, start)
    key = training_key(MATCHERS[config], settings, seed, sha256_file(start) if start else None)
    run(training, steps, key, out)
    return 0


def _train_images(
    files: tuple[list[BurstFile], list[BurstFile]],
    config: str,
    start: Path | None,
    steps: int,
    device: str,
    seed: int,
    out: Path,
) -> int:
    learned, hidden = files
    settings = ImageTraining(steps=steps, warm_up=min(300, max(1, steps // 10)))
    training = image_training.ImageNetworkTraining(learned, IMAGE_NETWORKS[config], settings, device, seed, start)
    key = image_training.training_key(IMAGE_NETWORKS[config], settings, seed, sha256_file(start) if start else None)
    image_training.run(training, key, out)
    if hidden:
        text = table(evaluate(training.network.eval(), hidden))
        write_text(out / "scores.md", text)
        print(f"hidden variants:\n{text}written: {out / 'scores.md'}")
    return 0
