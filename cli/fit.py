"""`fit`: a model of a recording, with what one wants to see of it."""

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

    Missing ticks are filled, bad pixels left out and unequal gains corrected; the report says what was found.
    A recording without poses (streams of `record` before a calibration) gets estimated ones. A killed fit resumes where
    it was. Poses and clocks are checked against the clip, and estimated anew where they are wrong. Cameras that the
    recording holds out are judged by their own spikes: their renders are in OUT/predictions.

    Args:
        scene: A scene folder, or a folder of streams that `record` has written.
        method: Method by name.
        settings: Other settings of the method, such as motion.lr_grid=0.005; see `spike4dgs methods NAME`.
        out: Folder for model.safetensors, sheet.png, video.mp4 and report.html.
        budget: quick, standard (4 times the steps), paper (the publication's steps), or a multiple of quick.
        poses: auto (given ones are adjusted where features say that they are wrong) or given.
        clocks: auto (the cameras' clocks are estimated from what moves, and used where they differ) or given.
    """
    wanted = with_settings(get_method(method), settings)
    request = FitRequest(make_budget(budget), choose_device_for([wanted], compute.device), compute.seed)
    fit_recording(scene, wanted, out, request, TFP, poses=poses, clocks=clocks)
    return 0
