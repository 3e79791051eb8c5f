"""Recipes that make each image, and find each start, once for all trials of a search: hardly a knob changes them."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.starts.base import Start, StartRequest


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
