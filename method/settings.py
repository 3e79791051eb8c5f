"""Settings by part: each part of a recipe has a frozen dataclass of numbers, overridden by dotted names.

For example:

    Recipe("mine", "tfp", "rig", "hexplane", "pixel", {"images.time_spacing_ticks": 20, "motion.lr_grid": 5e-3})
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from itertools import chain
from typing import Any, Self, TypeVar

from spike4dgs.benchmark.errors import problem, unknown
from spike4dgs.benchmark.method import Budget


@dataclass(frozen=True)
class Settings:
    """The numbers of one part. Learning rates are Adam's; `*_last` is reached log-linearly at a stage's end."""

    def scaled(self, scale: float) -> Self:
        """Return the same settings with the step counts, where there are some, multiplied by a budget's scale."""
        return self

    def denser(self, pace: float) -> Self:
        """Return the same settings for motion that is so many times faster."""
        return self


def check_numbers(part: str, wanted: Mapping[str, tuple[float, bool]]) -> None:
    """Raise UserError for the first number of a part that no fit can use: what is expected -> value, whether it is."""
    for expected, (value, holds) in wanted.items():
        if not holds:
            raise problem(f"settings of {part}", expected, str(value), "correct the number")


FLAT_FIELD = "flat_field"  # a setting of images, which initialisations that have it too follow
VIEWS_PER_STEP = "views_per_step"  # a setting of parts whose steps have several views
SettingsByPart = Mapping[str, Settings]
S = TypeVar("S", bound=Settings)


def override(parts: SettingsByPart, overrides: Mapping[str, Any], where: str) -> dict[str, Settings]:
    """Return the settings of all parts with `overrides`, by names PART.NAME.

    Raises UserError for an unknown part or name, or a value of another type.
    """
    changes: dict[str, dict[str, Any]] = {part: {} for part in parts}
    known = {part: sorted(f"{part}.{f.name}" for f in fields(settings)) for part, settings in parts.items()}
    for dotted, value in overrides.items():
        part, _, name = dotted.partition(".")
        if dotted not in known.get(part, ()):
            near = known.get(part) or chain.from_iterable(known.values())
            raise unknown(where, dotted, near, "`spike4dgs methods NAME`")
        changes[part][name] = value
    return {part: make_settings(changes[part], where, settings, f"{part}.") for part, settings in parts.items()}


def make_settings(overrides: Mapping[str, Any], where: str, defaults: S, prefix: str = "") -> S:
    """Return settings with `overrides` by name. Raises UserError for an unknown name or a value of another type."""
    known = sorted(f.name for f in fields(defaults))
    for name, value in overrides.items():
        if name not in known:
            raise unknown(where, prefix + name, [prefix + n for n in known])
        kind = type(getattr(defaults, name))
        if isinstance(value, bool) != (kind is bool) or not isinstance(value, (int, float) if kind is float else kind):
            raise problem(where, f"{prefix}{name} as {kind.__name__}", repr(value), "correct the value")
        if isinstance(value, float) and not math.isfinite(value):
            raise problem(where, f"a finite {prefix}{name}", repr(value), "correct the value")
    return replace(defaults, **overrides)


def scaled(parts: SettingsByPart, scale: float) -> dict[str, Settings]:
    """Return the settings of all parts with the step counts multiplied by a budget's scale."""
    return {part: settings.scaled(scale) for part, settings in parts.items()}


def in_budget(parts: SettingsByPart, budget: Budget, published: Mapping[str, Any], where: str) -> dict[str, Settings]:
    """Return the settings of all parts with the step counts of a budget.

    `published` are the publication's, by names PART.NAME, for steps of four views: where a part's steps have fewer,
    there are more of them. Raises UserError where the budget asks for these and there are none.
    """
    if not budget.published:
        return scaled(parts, budget.scale)
    if not published:
        expected = "a publication's step counts for --budget paper"
        raise problem(where, expected, "none", "choose another budget")
    views = [getattr(settings, VIEWS_PER_STEP) for settings in parts.values() if hasattr(settings, VIEWS_PER_STEP)]
    steps = {name: round(4 * count / views[0]) if views else count for name, count in published.items()}
    return override(parts, steps, where)


def follow_images(settings: SettingsByPart, overrides: Mapping[str, Any]) -> dict[str, Settings]:
    """Return settings whose initialisation corrects images where the fit's are corrected, unless overridden."""
    first = settings["initialization"]
    has = any(f.name == FLAT_FIELD for f in fields(first))
    if not has or f"initialization.{FLAT_FIELD}" in overrides:
        return dict(settings)
    images: Any = settings["images"]
    return {**settings, "initialization": replace(first, **{FLAT_FIELD: images.flat_field})}


def as_dict(parts: SettingsByPart) -> dict[str, dict[str, Any]]:
    """Return plain values by part and name, for records."""
    return {part: asdict(settings) for part, settings in parts.items()}
