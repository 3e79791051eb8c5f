"""Run hard cases one after the other: an exception makes a failed row, and the rest go on."""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.hard_cases.case import Case, NotRunError, Outcome, Setting


@dataclass(frozen=True)
class Row:
    """A case that was run. `error` is None where an exception came instead of a result, `passed` where nothing ran."""

    case: Case
    device: str
    came_out: str
    error: float | None
    finite: bool
    passed: bool | None
    seconds: float
    warnings: tuple[str, ...]


def choose(cases: Sequence[Case], pattern: str | None) -> list[Case]:
    """Return the cases whose id contains `pattern`, which may have the wildcards * and ?; all without a pattern.

    Raises UserError where there is none, or where two cases have one id.
    """
    ids = [case.id for case in cases]
    if twice := sorted({i for i in ids if ids.count(i) > 1}):
        raise problem("hard cases", "one case of each id", f"{twice[0]} twice", "rename one of them")
    if pattern is None:
        return list(cases)
    chosen = [case for case in cases if fnmatchcase(case.id.lower(), f"*{pattern.lower()}*")]
    if not chosen:
        parts = ", ".join(sorted({i.rpartition("/")[0] for i in ids}))
        raise problem("--only", "a part of the id of a case", repr(pattern), f"choose from {parts}")
    return chosen


def run_cases(cases: Sequence[Case], seed: int, device: str, tell: Callable[[int, int, str], None]) -> list[Row]:
    """Run cases in order and return a row of each. `tell(done, total, next case)` hears before each and at the end."""
    rows = []
    for done, case in enumerate(cases):
        tell(done, len(cases), case.id)
        with tempfile.TemporaryDirectory(prefix="spike4dgs-") as folder:
            rows.append(run_case(case, Setting(seed, device if case.on_device else "cpu", Path(folder))))
    tell(len(cases), len(cases), "")
    return rows


def run_case(case: Case, setting: Setting) -> Row:
    """Run one case. What Python warns of meanwhile is part of the row; it does not fail the case."""
    start = time.perf_counter()
    error: float | None
    with _heard() as heard:
        try:
            outcome = case.run(setting)
            error = float(outcome.error)
        except NotRunError as e:
            return Row(case, setting.device, f"not run: {e}", None, True, None, time.perf_counter() - start, ())
        except Exception as e:  # whatever a case does, the others are run
            outcome, error = Outcome(f"{type(e).__name__}: {str(e) or 'no message'}", 0.0, finite=False), None
    seconds = time.perf_counter() - start
    passed = error is not None and outcome.finite and error <= case.tolerance  # a NaN is within no tolerance
    return Row(case, setting.device, outcome.came_out, error, outcome.finite, passed, seconds, tuple(heard))


@contextmanager
def _heard() -> Iterator[list[str]]:
    """Yield a list that afterwards holds the distinct warnings that numpy and others gave."""
    found: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield found
    texts = (f"{w.category.__name__}: {w.message}" for w in caught if not issubclass(w.category, DeprecationWarning))
    found.extend(dict.fromkeys(texts))
