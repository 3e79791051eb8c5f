"""A hard case: an input that tends to break a program, what it is compared with, and the error that is allowed.

Each room lists its own cases with the functions here. A case passes when all that came out is finite where it should
be, and the worst error is within the tolerance. A case that raises an exception fails.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from spike4dgs.benchmark.errors import UserError

Kind = Literal["twin", "seeds", "resume", "threads"]


class NotRunError(Exception):
    """A case cannot run on this machine; the message says what is missing. It neither passes nor fails."""


@dataclass(frozen=True)
class Setting:
    """What a case is run with: a seed for its random inputs, a device, and an empty folder for its files."""

    seed: int
    device: str
    folder: Path

    def rng(self) -> np.random.Generator:
        """Return a fresh random generator, the same for every call."""
        return np.random.default_rng(self.seed)


@dataclass(frozen=True)
class Outcome:
    """What came out of a case: in words, the worst error in the case's unit, and whether it was finite."""

    came_out: str
    error: float
    finite: bool = True


@dataclass(frozen=True, kw_only=True)
class Case:
    """One row of the report.

    `id` is room/part/name. `kind` says what the error is: a distance to a twin, to a run with the same seed, to an
    uninterrupted run, or to a run with one thread.
    """

    id: str
    asked: str  # one phrase: the input, and what was to be done with it
    twin: str  # the independent result beside it
    unit: str  # of the error and the tolerance
    tolerance: float  # largest error that passes
    run: Callable[[Setting], Outcome]
    kind: Kind = "twin"
    on_device: bool = False  # it computes on the device of the setting, not always on the CPU
    seconds: float = 0.1  # that it takes on two cores, for the estimate of the time left


def compare(found: ArrayLike, expected: ArrayLike, *, relative: bool = False) -> Outcome:
    """Return the worst absolute difference of two arrays, or the L2 norm of it relative to the expected array's.

    Where the expected value is NaN the found one has to be NaN too; elsewhere it has to be finite. Arrays of different
    shapes differ by infinity.

    >>> compare([1.0, 2.0], [1.0, 2.5]).error
    0.5
    """
    a, b = (np.asarray(x, np.float64) for x in (found, expected))
    if a.shape != b.shape:
        return Outcome(f"shape {a.shape} where {b.shape} was expected", np.inf)
    known = ~np.isnan(b)
    finite = bool(np.isfinite(a[known]).all()) and bool(np.isnan(a[~known]).all())
    difference, size = np.abs(a - b)[known], np.linalg.norm(b[known])
    if relative:
        error = float(np.linalg.norm(difference) / size) if size > 0 else float(np.linalg.norm(difference))
    else:
        error = float(difference.max(initial=0.0))
    return Outcome(described(a), error, finite)


def described(values: np.ndarray[Any, Any]) -> str:
    """Return an array in words: its shape and its range, or its value if it has one.

    >>> described(np.array([[0.25, 1.0]]))
    '1x2 values from 0.25 to 1'
    """
    if values.size == 1:
        return f"{float(values.reshape(-1)[0]):.6g}"
    shape = "x".join(map(str, values.shape))
    known = values[np.isfinite(values)]
    if not known.size:
        return f"{shape} values, none of them finite" if values.size else "nothing"
    missing = values.size - known.size
    text = f"{shape} values from {known.min():.4g} to {known.max():.4g}"
    return text + (f", {missing} not finite" if missing else "")


def worst(outcomes: Mapping[str, Outcome]) -> Outcome:
    """Return the outcome with the largest error among several, with its name; finite if all are.

    >>> worst({"a": Outcome("1", 0.0), "b": Outcome("2", 0.5)})
    Outcome(came_out='2 of 2 compared; the worst is b: 2', error=0.5, finite=True)
    """
    order = sorted(outcomes, key=lambda name: (outcomes[name].finite, -_number(outcomes[name].error)))
    first = order[0]
    text = f"{len(outcomes)} of {len(outcomes)} compared; the worst is {first}: {outcomes[first].came_out}"
    return Outcome(text, outcomes[first].error, all(o.finite for o in outcomes.values()))


def _number(error: float) -> float:
    return np.inf if np.isnan(error) else error


def refused(calls: Mapping[str, Callable[[], object]]) -> Outcome:
    """Return how many calls were not refused with a UserError; `came_out` quotes the first refusal or acceptance."""
    accepted, messages = [], []
    for name, call in calls.items():
        try:
            accepted.append(f"{name} gave {type(call()).__name__}")
        except UserError as e:
            messages.append(str(e))
    said = f"refused {len(messages)} of {len(calls)}: {messages[0]}" if messages else "refused nothing"
    return Outcome("; ".join([*accepted, said]), float(len(accepted)))
