"""Fits of a search's trials: recipes that make each image, and find each start, once, and what a fit scores."""

from __future__ import annotations

import hashlib
import pickle
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.method import make_budget
from spike4dgs.benchmark.runs.run import Settings, run_matrix
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.starts.base import Start, StartRequest

METRICS = ("psnr", "psnr_dynamic")
Fit = Callable[[RecipeMethod, Scene], Mapping[str, float]]


def keeping(method: RecipeMethod, device: str) -> RecipeMethod:
    """Return the same recipe, whose images on `device` and whose starts are remembered; every bit stays."""
    recipe, parts = method.recipe, method.parts
    maker, first = method.images.on(device), method.initialization
    own: dict[str, Any] = {
        name: _images(f) for name in ("rate", "corrected", "rate_over") if (f := getattr(maker, name))
    }
    images = {**parts.images, recipe.images: replace(maker, made_on=None, **own)}
    starts = {**parts.initialization, recipe.initialization: replace(first, start=_starts(first.start))}
    return RecipeMethod(recipe, replace(parts, images=images, initialization=starts), method.description)


def _images(make: Callable[..., Any]) -> Callable[..., Any]:
    """Return `make`, which gets a stream, a tick and further arguments, with a memory."""
    known: dict[str, Any] = {}

    def kept(stream: SpikeStream, *rest: Any, **light: Any) -> Any:
        key = _digest(stream.packed.tobytes(), stream.gaps, stream.filled, rest, light)
        if key not in known:
            known[key] = make(stream, *rest, **light)
        return known[key]

    return kept


def _starts(start: Callable[[StartRequest], Start]) -> Callable[[StartRequest], Start]:
    known: dict[str, Start] = {}

    def kept(request: StartRequest) -> Start:
        key = _digest(request.scene.revision, request.seed, request.settings, request.device)
        if key not in known:
            known[key] = start(request)
        return known[key]

    return kept


def _digest(*values: Any) -> str:
    return hashlib.sha256(pickle.dumps(values)).hexdigest()


def fit_by(seed: int, device: str, budget: str) -> Fit:
    """Return what fits a recipe on a scene and returns its `METRICS`, each 0 dB where the fit fails.

    It raises UserError where a fit cannot begin, as without weights.
    """

    def fit(method: RecipeMethod, scene: Scene) -> dict[str, float]:
        with tempfile.TemporaryDirectory(prefix="spike4dgs-tuning-") as folder:
            settings = Settings(Path(folder), seed, device, make_budget(budget), ())
            (record,) = run_matrix([scene], [method], settings, Console(quiet=True))
        cell = record["scenes"][scene.id]
        if cell["status"] == "skipped":
            fix = "mend that, then repeat the command"
            raise problem(f"{method.name} on {scene.id}", "a fit", str(cell["error"]), fix)
        if cell["status"] != "ok":
            print(f"{method.name} on {scene.id}: {cell['error']}", file=sys.stderr)
            return dict.fromkeys(METRICS, 0.0)
        return {name: cell["metrics"][name] for name in METRICS}

    return fit
