"""`report hard-cases`: run the rooms' cases, then write OUT/index.html and OUT/hard_cases.json."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from spike4dgs.benchmark.environment import choose_device, command_line, environment, harness, utc_now
from spike4dgs.benchmark.files import write_json
from spike4dgs.benchmark.hard_cases.case import Case
from spike4dgs.benchmark.hard_cases.run import Row, choose, run_cases
from spike4dgs.benchmark.schemas import check_schema, load_schema

FORMAT = "spike4dgs-hard-cases/1"
Room = Callable[[], Sequence[Case]]


def make_hard_cases(*rooms: Room) -> Callable[..., int]:
    """Return the command, given the rooms' cases, in the order of the page."""

    def hard_cases(
        *,
        out: Path = Path("runs/hard-cases"),
        only: str | None = None,
        seed: int = 0,
        device: Literal["auto", "cpu", "cuda"] = "cpu",
    ) -> int:
        """Run hard inputs through every part of the project, each beside an independent result, and write one page.

        A case passes if what came out is finite and its worst error is within the tolerance beside it. Other rows run
        one thing twice: with the same and with other seeds, interrupted and resumed, on one and on more threads. Writes
        OUT/index.html, which opens from the disk, and OUT/hard_cases.json. Takes minutes on two cores; the first run
        also compiles. Returns 1 if a case fails.

        Args:
            out: Folder for the page and the JSON.
            only: Run the cases whose id contains this; * and ? are wildcards. Ids are room/part/name.
            seed: Seed of all random inputs.
            device: cpu, cuda, or auto: cuda where there is one. Cases of CPU kernels stay on the CPU.
        """
        device = choose_device(device)  # type: ignore[assignment]
        cases = choose([case for room in rooms for case in room()], only)
        start = utc_now()
        rows = run_cases(cases, seed, device, progress(cases))
        report = {
            "format": FORMAT, "seed": seed, "device": device, "only": only, "started": start, "finished": utc_now(),
            "command": command_line(), "harness": harness(), "environment": environment(device),
            "cases": [as_dict(row) for row in rows],
        }  # fmt: skip
        return write_report(report, out)

    return hard_cases


def as_dict(row: Row) -> dict[str, Any]:
    """Return a row for JSON, which has no infinity and no NaN: such an error is null, and the case has failed."""
    case = row.case
    texts = {name: getattr(case, name) for name in ("id", "kind", "asked", "twin", "unit")}
    error = row.error if row.error is not None and math.isfinite(row.error) else None
    return {
        **texts,
        "device": row.device,
        "came_out": row.came_out,
        "error": error,
        "tolerance": float(case.tolerance),
        "finite": row.finite,
        "passed": row.passed,
        "seconds": row.seconds,
        "warnings": list(row.warnings),
    }


def write_report(report: dict[str, Any], out: Path) -> int:
    """Write the JSON and the page; return 1 if a case failed, else 0."""
    from spike4dgs.benchmark.reports.hard_cases.content import counted, write_content

    check_schema(report, load_schema("spike4dgs.benchmark", "hard_cases.schema.json"), "the report", "report this")
    write_json(out / "hard_cases.json", report)
    write_content(out / "index.html", report)
    failed = [c for c in report["cases"] if c["passed"] is False]
    for c in failed:
        _say(f"failed: {c['id']}: {c['came_out']}")
    _say(f"{counted(report['cases'])}\npage: {out / 'index.html'}\nJSON: {out / 'hard_cases.json'}")
    return 1 if failed else 0


def progress(cases: Sequence[Case]) -> Callable[[int, int, str], None]:
    """Return a listener that says which part runs, and for how long the rest will: by what the cases say they take."""
    began, said = time.perf_counter(), [""]

    def tell(done: int, total: int, next_case: str) -> None:
        part = next_case.rpartition("/")[0]
        if not next_case or part == said[0]:
            return
        said[0] = part
        told, left = (sum(c.seconds for c in some) for some in (cases[:done], cases[done:]))
        factor = (time.perf_counter() - began) / told if told else 1.0
        _say(f"[{done + 1}/{total}] {part}; about {max(factor, 0.1) * left:.0f} s to go")

    return tell


def _say(line: str) -> None:
    print(line, flush=True)
