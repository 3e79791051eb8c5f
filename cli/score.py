"""`score`: score a predictions folder from any program."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.files import check_file
from spike4dgs.benchmark.metrics.measure import AUTO, select_metrics
from spike4dgs.benchmark.runs.display import cell_summary, metrics_summary
from spike4dgs.benchmark.runs.record import write_record
from spike4dgs.benchmark.runs.score import score_predictions
from spike4dgs.benchmark.scene.scene import open_scenes


def score(
    predictions: Positional[Path],
    scenes: Positional[tuple[Path, ...]],
    *,
    out: Path | None = None,
    metrics: tuple[str, ...] = (AUTO,),
    split: str | None = None,
    allow_gaps: bool = False,
) -> int:
    """Score the predictions of any program from their files. Without ground truth, held-out spikes are the reference.

    Args:
        predictions: Predictions folder (images, SHA256SUMS, prediction.json); for several scenes, the folder that
            holds one predictions folder per scene id.
        scenes: Scene folders.
        out: Write the result record to this file.
        metrics: auto (all that this machine can compute), or ids such as lpips_vgg. PSNR, SSIM and the temporal error
            are always computed.
        split: Split that the predictions are for; each scene's default if left out.
        allow_gaps: Accept recordings with gaps.
    """
    if out is not None:
        check_file(out)
    record = score_predictions(predictions, open_scenes(scenes, allow_gaps, split), select_metrics(metrics))
    name = record["method"]["name"] + (f", split {split}," if split else "")
    for scene, cell in record["scenes"].items():
        print(f"{name} on {scene}: {cell_summary(cell)}")
    if len(record["scenes"]) > 1:
        print(f"{name}, mean of {len(record['scenes'])} scenes: {metrics_summary(record['mean'])}")
    if out:
        write_record(out, record)
        print(f"record with every metric: {out}")
    return 0
