"""Fit methods on the training parts of hidden scenes, and render their targets. Nothing is scored."""

from __future__ import annotations

import traceback
from collections.abc import Sequence

from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.files import locked, write_text
from spike4dgs.benchmark.method import Method, get_method
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.benchmark.runs.cell import Job, is_done, run_job
from spike4dgs.benchmark.runs.display import RunDisplay
from spike4dgs.benchmark.runs.run import Settings, predictions_folder
from spike4dgs.benchmark.scene.scene import Scene


def find_chosen(names: Sequence[str], device: str) -> tuple[list[Method], str]:
    """Return installed methods by name, and the device on which they run."""
    methods = [get_method(name) for name in names]
    return methods, choose_device(device, rasterizes=any(getattr(m, "rasterizes", True) for m in methods))


def predict_all(scenes: Sequence[Scene], methods: Sequence[Method], settings: Settings) -> set[str]:
    """Fit every method on every scene and write predictions, or keep those that are there.

    Return the names of the methods that failed on a scene; the traceback is in a log file.
    """
    failed, out = set(), settings.out
    with (
        locked(out / ".lock", out, "a folder that no other run uses"),
        RunDisplay(make_console(), len(scenes) * len(methods)) as display,
    ):
        for method in methods:
            for scene in scenes:
                job = Job(method, scene, settings.seed, settings.device, settings.budget)
                folder = predictions_folder(out, method.name, scene.id)
                with display.cell(f"{method.name} on {scene.id}") as shown:
                    if is_done(job, folder):
                        shown.note("predictions are there")
                        continue
                    model = out / "models" / method.name / f"{scene.id}.safetensors"
                    try:
                        run_job(job, [folder], model, out / "work" / job.key[:16], shown.progress, shown.note)
                    except Exception as e:  # whatever a method does wrong is its own failure, not the run's
                        log = out / "logs" / f"{method.name}__{scene.id}.log"
                        write_text(log, traceback.format_exc())
                        shown.note(f"failed: {e} (see {log})")
                        failed.add(method.name)
    return failed
