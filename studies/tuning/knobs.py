"""What a search may change in a recipe: the same knobs for every row, as far as the row has them.

A knob is a choice among a few values or a factor on a group of rates, and becomes settings by names PART.NAME. No knob
changes what a method is given, and none gives it more work: steps of two views are `STEPS_OF_TWO` times as many as
steps of four, which takes the same time, and what one stage gains another loses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from spike4dgs.method.settings import Settings, SettingsByPart

STEPS_OF_TWO = 1.6  # steps of two views in the time of one step of four (200x125 pixels, two cores)
_CUSTOMARY, _BOX = "0.3 px^2", "1/12 px^2, compensated"
Values = Mapping[str, Any]  # by knob, or by PART.NAME


@dataclass(frozen=True)
class Knob:
    """One dimension of the search: one of `choices`, or a number between `low` and `high` on a log scale."""

    name: str
    choices: tuple[Any, ...] = ()
    low: float = 0.0
    high: float = 0.0


def knobs_of(settings: SettingsByPart) -> tuple[Knob, ...]:
    """Return the knobs that a recipe with these settings has."""
    return tuple(knob for knob, has, _ in _KNOBS if has(settings))


def as_settings(values: Values, settings: SettingsByPart) -> dict[str, Any]:
    """Return the settings, by PART.NAME, that the values of knobs give a recipe whose own settings are `settings`."""
    found: dict[str, Any] = {}
    for knob, _, give in _KNOBS:
        if knob.name in values:
            found |= give(values[knob.name], settings)
    return found | _steps(values, settings)


def start_of(settings: SettingsByPart) -> dict[str, Any]:
    """Return the values of knobs that stand for a recipe as it is, each choice the one nearest to its own setting."""
    return {knob.name: _own(knob, settings) for knob in knobs_of(settings)}


def _own(knob: Knob, settings: SettingsByPart) -> Any:
    if not knob.choices:
        return 1.0 if knob.name.endswith("rates") else _static_share(settings)
    trainer = settings.get("trainer")
    own = {
        "filter": lambda: _BOX if getattr(trainer, "filter_compensated", False) else _CUSTOMARY,
        "times": lambda: _value(settings, "images", "time_spacing_ticks"),
    }
    where = _PLACES.get(knob.name)
    value = own[knob.name]() if knob.name in own else _value(settings, *where) if where else None
    if value in knob.choices:
        return value
    return min(knob.choices, key=lambda choice: abs(choice - value))


def _value(settings: SettingsByPart, part: str, name: str) -> Any:
    return getattr(settings[part], name)


def _has(part: str, *names: str) -> Callable[[SettingsByPart], bool]:
    return lambda settings: part in settings and all(hasattr(settings[part], name) for name in names)


def _set(part: str, name: str) -> Callable[[Any, SettingsByPart], dict[str, Any]]:
    return lambda value, settings: {f"{part}.{name}": type(_value(settings, part, name))(value)}


def _scaled_rates(part: str) -> Callable[[Any, SettingsByPart], dict[str, Any]]:
    """Return what multiplies every rate of a part; `lr_last`, a ratio, and the rates of poses stay."""

    def give(factor: float, settings: SettingsByPart) -> dict[str, Any]:
        return {f"{part}.{name}": value * factor for name, value in rates(settings[part]).items()}

    return give


def rates(part: Settings) -> dict[str, float]:
    """Return the learning rates of a part, by name."""
    return {
        name: value
        for name, value in asdict(part).items()
        if name.startswith("lr_") and name != "lr_last" and not name.startswith("lr_poses")
    }


def _filter(value: str, settings: SettingsByPart) -> dict[str, Any]:
    box = value == _BOX
    return {"trainer.filter_variance": 1 / 12 if box else 0.3, "trainer.filter_compensated": box}


def _static_share(settings: SettingsByPart) -> float:
    trainer: Any = settings["trainer"]
    return float(trainer.coarse_steps / (trainer.coarse_steps + trainer.fine_steps))


def _steps(values: Values, settings: SettingsByPart) -> dict[str, Any]:
    """Return the steps of both stages: in all as much work as the recipe's own, split by `static_share`."""
    if "static_share" not in values:
        return {}
    trainer: Any = settings["trainer"]
    views = values.get("views_per_step", trainer.views_per_step)
    cost = {2: 1.0, 4: STEPS_OF_TWO}  # of a step
    total = (trainer.coarse_steps + trainer.fine_steps) * cost[trainer.views_per_step] / cost[views]
    coarse = round(total * values["static_share"])
    return {"trainer.coarse_steps": coarse, "trainer.fine_steps": round(total) - coarse}


def _tracked_times(value: int, settings: SettingsByPart) -> dict[str, Any]:
    """Return the spacing of times that are tracked one by one, and as many steps in all as before."""
    own = _value(settings, "images", "time_spacing_ticks")
    later = round(_value(settings, "motion", "later_steps") * value / own)
    return {"images.time_spacing_ticks": value, "motion.later_steps": later}


def _moves(settings: SettingsByPart) -> bool:
    return "trainer" in settings and "motion" in settings


_PLACES = {
    "last_rate": ("trainer", "lr_last"),
    "first_scale": ("trainer", "initial_scale"),
    "views_per_step": ("trainer", "views_per_step"),
    "average": ("trainer", "average"),
    "time_cell": ("motion", "cell_ticks"),
    "copies": ("motion", "moving_copies"),
    "lifetime": ("motion", "moving_temporal_scale"),
    "window": ("image_maker", "half_window"),
    "loss": ("supervision", "huber_delta"),
}


# A knob, whether a recipe with some settings has it, and the settings that a value of it gives.
_Entry = tuple[Knob, Callable[[SettingsByPart], bool], Callable[[Any, SettingsByPart], dict[str, Any]]]


def _choice(name: str, *choices: Any) -> _Entry:
    return Knob(name, choices), _has(*_PLACES[name]), _set(*_PLACES[name])


_KNOBS: tuple[_Entry, ...] = (
    (Knob("rates", low=0.5, high=8), _has("trainer", "lr_means"), _scaled_rates("trainer")),
    (
        Knob("motion_rates", low=0.25, high=8),
        lambda s: "motion" in s and bool(rates(s["motion"])),
        _scaled_rates("motion"),
    ),
    (Knob("filter", (_CUSTOMARY, _BOX)), _has("trainer", "filter_variance"), _filter),
    (Knob("static_share", low=0.1, high=0.5), _moves, lambda value, settings: {}),
    _choice("last_rate", 1.0, 0.3, 0.1),
    _choice("first_scale", 0.5, 0.7, 1.0),
    _choice("views_per_step", 2, 4),
    _choice("average", 0.0, 0.2),
    _choice("time_cell", 16.0, 32.0, 64.0, 100.0),
    _choice("copies", 2, 3, 5, 8),
    _choice("lifetime", 0.1, 0.2, 0.3, 0.6),
    _choice("window", 10, 14, 20, 28, 40),
    _choice("loss", 0.0, 0.02, 0.05),
    (Knob("times", (10, 16, 24)), _has("motion", "later_steps"), _tracked_times),
)
