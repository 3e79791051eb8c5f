"""What a search may change in a recipe: the same knobs for every row, as far as the row has them.

A knob is a choice among a few values or a factor on a group of rates, and becomes settings by names PART.NAME. No knob
changes what a method is given, and none gives it more work: steps of two views are `STEPS_OF_TWO` times as many as
steps of four, which takes the same time, and what one stage gains another loses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from spike4dgs.method.settings import Settings, SettingsByPart

STEPS_OF_TWO = 1.6  # steps of two views in the time of one step of four (200x125 pixels, two cores)
_SHARES = 0.1, 0.5  # of the static stage
_CUSTOMARY, _BOX = "0.3 px^2", "1/12 px^2, compensated"
Values = Mapping[str, Any]  # by knob, or by PART.NAME
Parts = Mapping[str, Any]  # the settings of a recipe by part


@dataclass(frozen=True)
class Knob:
    """One dimension of the search: one of `choices`, or a number between `low` and `high` on a log scale.

    Attributes:
        has: whether a recipe with some settings has the knob.
        own: the value that stands for these settings; of a choice, the nearest one does.
        give: the settings, by PART.NAME, that the values of all knobs give in place of some settings.
    """

    name: str
    has: Callable[[Parts], bool]
    own: Callable[[Parts], Any]
    give: Callable[[Values, Parts], dict[str, Any]]
    choices: tuple[Any, ...] = ()
    low: float = 0.0
    high: float = 0.0

    def start(self, settings: Parts) -> Any:
        """Return the value that stands for a recipe as it is."""
        own = self.own(settings)
        if not self.choices or own in self.choices:
            return own
        return min(self.choices, key=lambda choice: abs(choice - own))


def knobs_of(settings: SettingsByPart) -> tuple[Knob, ...]:
    """Return the knobs that a recipe with these settings has."""
    return tuple(knob for knob in KNOBS if knob.has(settings))


def as_settings(values: Values, settings: SettingsByPart) -> dict[str, Any]:
    """Return the settings, by PART.NAME, that the values of knobs give a recipe whose own settings are `settings`."""
    return {name: value for knob in KNOBS if knob.name in values for name, value in knob.give(values, settings).items()}


def start_of(settings: SettingsByPart) -> dict[str, Any]:
    """Return the values of knobs that stand for a recipe as it is."""
    return {knob.name: knob.start(settings) for knob in knobs_of(settings)}


def rates(part: Settings) -> dict[str, float]:
    """Return the learning rates of a part, by name; `lr_last`, a ratio, and the rates of poses are none."""
    return {
        name: value
        for name, value in asdict(part).items()
        if name.startswith("lr_") and name != "lr_last" and not name.startswith("lr_poses")
    }


def _factor(name: str, part: str, low: float, high: float) -> Knob:
    """Return the knob of a factor on every rate of a part."""

    def give(values: Values, settings: Parts) -> dict[str, Any]:
        return {f"{part}.{rate}": value * values[name] for rate, value in rates(settings[part]).items()}

    return Knob(name, lambda s: part in s and bool(rates(s[part])), lambda s: 1.0, give, low=low, high=high)


def _choice(name: str, part: str, setting: str, *choices: Any) -> Knob:
    """Return the knob of one setting."""

    def give(values: Values, settings: Parts) -> dict[str, Any]:
        return {f"{part}.{setting}": type(getattr(settings[part], setting))(values[name])}

    return Knob(name, _has(part, setting), lambda s: getattr(s[part], setting), give, choices)


def _has(part: str, setting: str) -> Callable[[Parts], bool]:
    return lambda s: part in s and hasattr(s[part], setting)


def _filter(values: Values, settings: Parts) -> dict[str, Any]:
    box = values["filter"] == _BOX
    return {"trainer.filter_variance": 1 / 12 if box else 0.3, "trainer.filter_compensated": box}


def _steps(values: Values, settings: Parts) -> dict[str, Any]:
    """Return the steps of both stages: in all as much work as the recipe's own."""
    trainer = settings["trainer"]
    cost = {2: 1.0, 4: STEPS_OF_TWO}  # of a step, by its views
    total = (trainer.coarse_steps + trainer.fine_steps) * cost[trainer.views_per_step] / cost[values["views_per_step"]]
    coarse = round(total * values["static_share"])
    return {"trainer.coarse_steps": coarse, "trainer.fine_steps": round(total) - coarse}


def _static_share(settings: Parts) -> float:
    trainer = settings["trainer"]
    return float(trainer.coarse_steps / (trainer.coarse_steps + trainer.fine_steps))


def _has_static_share(settings: Parts) -> bool:
    """Return whether a recipe splits its steps as a search may: one that stands still has a stage of them alone."""
    return _has("trainer", "coarse_steps")(settings) and _SHARES[0] <= _static_share(settings) <= _SHARES[1]


def _tracked_times(values: Values, settings: Parts) -> dict[str, Any]:
    """Return the spacing of times that are tracked one by one, and as many steps in all as before."""
    later = round(settings["motion"].later_steps * values["times"] / settings["images"].time_spacing_ticks)
    return {"images.time_spacing_ticks": values["times"], "motion.later_steps": later}


KNOBS = (
    _factor("rates", "trainer", 0.5, 8),
    _factor("motion_rates", "motion", 0.25, 8),
    Knob(
        "filter",
        _has("trainer", "filter_variance"),
        lambda s: _BOX if s["trainer"].filter_compensated else _CUSTOMARY,
        _filter,
        (_CUSTOMARY, _BOX),
    ),
    Knob("static_share", _has_static_share, _static_share, _steps, low=_SHARES[0], high=_SHARES[1]),
    _choice("last_rate", "trainer", "lr_last", 1.0, 0.3, 0.1),
    _choice("first_scale", "trainer", "initial_scale", 0.5, 0.7, 1.0),
    replace(_choice("views_per_step", "trainer", "views_per_step", 2, 4), has=_has_static_share),  # steps follow there
    _choice("average", "trainer", "average", 0.0, 0.2),
    _choice("time_cell", "motion", "cell_ticks", 16.0, 40.0, 64.0, 100.0),
    _choice("copies", "motion", "moving_copies", 2, 3, 5, 8),
    _choice("lifetime", "motion", "moving_temporal_scale", 0.1, 0.2, 0.3, 0.6),
    _choice("window", "image_maker", "half_window", 10, 14, 20, 28, 40),
    _choice("loss", "supervision", "huber_delta", 0.0, 0.02, 0.05),
    Knob(
        "times",
        _has("motion", "later_steps"),
        lambda s: s["images"].time_spacing_ticks,
        _tracked_times,
        (10, 16, 24),
    ),
)
