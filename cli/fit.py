"""`fit`: fit a model to a recording, and write a sheet, a video and a report."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import OmitArgPrefixes, Positional

from spike4dgs.baselines.images.tfp import TFP
from spike4dgs.benchmark.method import (
    DEFAULT_BUDGET,
    FitRequest,
    choose_device_for,
    get_method,
    make_budget,
    with_settings,
)
from spike4dgs.cli.options import COMPUTE, Compute, SetValues
from spike4dgs.method.recordings.fit import fit_recording
from spike4dgs.method.recordings.self_calibrated import Source


def fit(
    scene: Positional[Path],
    *,
    method: str = "spike4dgs-x",
    settings: SetValues = (),
    out: Path = Path("runs/fit"),
    budget: str = DEFAULT_BUDGET,
    compute: OmitArgPrefixes[Compute] = COMPUTE,
    poses: Source = "auto",
    clocks: Source = "auto",
) -> int:
    """Fit a model to a recording, and write a sheet, a slow-motion video and a report. No ground truth is needed.

    Missing ticks are filled, bad pixels left out and unequal gains corrected; the report says what was found. If a
    recording has no poses (streams of `record` before a calibration), they are estimated. Poses and clocks are checked
    against the clip, and corrected if they are wrong. Held-out cameras are judged by their own spikes; their renders
    are in OUT/predictions. A killed fit resumes where it stopped.

    Args:
        scene: A scene folder, or a folder of streams from `record` or `import-dat`.
        method: Name of the method.
        settings: Other settings of the method, such as trainer.lr_means=0.0002; see `spike4dgs methods NAME`.
        out: Folder for model.safetensors, sheet.png, video.mp4 and report.html.
        budget: quick, standard (4 times the steps), paper (the publication's steps), or a multiple of quick.
        poses: auto (given poses are adjusted if matched features show that they are wrong) or given.
        clocks: auto (the cameras' clocks are estimated from the moving parts, and used if they differ) or given.
    """
    wanted = with_settings(get_method(method, where="--method"), settings)
    request = FitRequest(make_budget(budget), choose_device_for([wanted], compute.device), compute.seed)
    fit_recording(scene, wanted, out, request, TFP, poses=poses, clocks=clocks)
    return 0
