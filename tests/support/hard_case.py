"""The fixture of tests marked `hard_case`: it checks errors against a tolerance and keeps a row for the report.

The marker says what is asked, the independent `twin`, and the `unit` and `tolerance` of the error (0 unless given).
`kind` is twin, seeds, resume or threads; a case with `on_device` computes on the device that the report is made for.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from numpy.typing import ArrayLike

from spike4dgs.benchmark.environment import available_cores
from spike4dgs.benchmark.errors import UserError

SETTING = 7, "cpu"  # seed and device; the report sets others
REFUSAL = {"twin": "the contract: one clear error each", "unit": "inputs taken"}
BYTES = {"unit": "bytes that differ"}


@dataclass(frozen=True)
class HardCase:
    """A case that runs: its seed and device, an empty folder, and its row, which keeps the worst of its checks."""

    seed: int
    device: str
    folder: Path
    row: dict[str, Any]

    def rng(self) -> np.random.Generator:
        """Return a fresh random generator, the same for every call."""
        return np.random.default_rng(self.seed)

    def check(self, error: float, came_out: str, finite: bool = True) -> None:
        """Fail unless a result is finite and its error within the tolerance; NaN is within none."""
        row = self.row
        worse = row["error"] is None or not error <= row["error"] or not finite
        if worse and row["finite"]:
            row |= {"error": float(error), "came_out": came_out, "finite": bool(finite)}
        assert finite, came_out
        assert error <= row["tolerance"], f"{came_out}: {error:g} {row['unit']}"

    def close(self, found: ArrayLike, expected: ArrayLike, name: str = "", *, relative: bool = False) -> None:
        """Check the worst absolute difference of two arrays, or its L2 norm relative to the expected array's.

        Where the expected value is NaN the found one has to be NaN too; elsewhere it has to be finite.
        """
        a, b = (np.asarray(x, np.float64) for x in (found, expected))
        assert a.shape == b.shape, f"{name}: shape {a.shape} where {b.shape} was expected"
        known = ~np.isnan(b)
        finite = bool(np.isfinite(a[known]).all()) and bool(np.isnan(a[~known]).all())
        difference, size = np.abs(a - b)[known], np.linalg.norm(b[known])
        if relative:
            error = float(np.linalg.norm(difference) / (size if size > 0 else 1.0))
        else:
            error = float(difference.max(initial=0.0))
        self.check(error, f"{name}: {described(a)}".removeprefix(": "), finite)

    def refused(self, calls: Mapping[str, Callable[[], object]]) -> None:
        """Check that every call is refused with a UserError."""
        accepted, messages = [], []
        for name, call in calls.items():
            try:
                accepted.append(f"{name} gave {type(call()).__name__}")
            except UserError as e:
                messages.append(str(e))
                assert "\n" not in str(e), "one clear error is one line"
        said = f"refused {len(messages)} of {len(calls)}: {messages[0]}" if messages else "refused nothing"
        self.check(len(accepted), "; ".join([*accepted, said]))

    def same_bytes(self, results: Sequence[bytes], names: Sequence[str]) -> None:
        """Check how many bytes of each result differ from the first one's."""
        first = np.frombuffer(results[0], np.uint8)
        wrong = {}
        for name, result in zip(names[1:], results[1:], strict=True):
            other = np.frombuffer(result, np.uint8)
            same_size = len(first) == len(other)
            wrong[name] = int(np.count_nonzero(first != other)) if same_size else max(len(first), len(other))
        differ = ", ".join(name for name, count in wrong.items() if count)
        text = f"{differ} differ" if differ else f"the same with {', '.join(names)}"
        self.check(max(wrong.values(), default=0), f"{len(first):,} bytes; {text}")

    def same_on_all_cores(self, compute: Callable[[], bytes]) -> None:
        """Check that a result has the same bytes on one core and on 2, 4 ... all cores."""
        results = []
        for cores in core_counts():
            with on_cores(cores):
                results.append(compute())
        self.same_bytes(results, [f"{n} cores" for n in core_counts()])


@pytest.fixture
def hard_case(request: pytest.FixtureRequest, tmp_path: Path) -> HardCase:
    """Return the running test's hard case; its row is a property of the test."""
    row: dict[str, Any] = {"unit": "", "tolerance": 0.0, "kind": "twin"}
    for mark in reversed(list(request.node.iter_markers("hard_case"))):
        row |= mark.kwargs
    if hasattr(request.node, "callspec"):
        row["asked"] = row["asked"].format(**request.node.callspec.params)
    seed, device = getattr(request.config, "hard_case_setting", SETTING)
    device = device if row.pop("on_device", False) else "cpu"
    row |= {"device": device, "came_out": "nothing was checked", "error": None, "finite": True}
    request.node.user_properties.append(("hard_case", row))
    return HardCase(seed, device, tmp_path, row)


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


def core_counts() -> list[int]:
    """Return the numbers of cores to try: 1, 2, 4 ... and all that this process may use."""
    most = available_cores()
    return sorted({min(2**k, most) for k in range(most.bit_length())} | {most})


@contextmanager
def on_cores(count: int) -> Iterator[None]:
    """Run on the first `count` cores of this process only: parts that start a thread a core start that many."""
    process = psutil.Process()
    if not hasattr(process, "cpu_affinity"):
        pytest.skip("this system binds no process to cores")
    before = process.cpu_affinity()
    process.cpu_affinity(before[:count])
    try:
        yield
    finally:
        process.cpu_affinity(before)
