"""Measure one after the other; each result is a file at once, so that a killed report goes on where it was."""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.environment import cpu_name, harness, utc, utc_now
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import read_json, sha256_json, write_json
from spike4dgs.studies.speed_error.measurement import GROUPS, Measurement, Point, Request, Series

Result = dict[str, Any]  # a measurement of speed_error.schema.json
_UNKNOWN_S = 10.0  # of a measurement that does not say how long it takes


def measure_all(
    measurements: Sequence[Measurement], request: Request, folder: Path, key: dict[str, Any], say: Callable[[str], None]
) -> list[Result]:
    """Return a result for each measurement, failed ones too. Files FOLDER/ID.json of the same `key` are kept."""
    left = {m.id: m.seconds.get(request.size, _UNKNOWN_S) for m in measurements}
    told = spent = 0.0  # seconds: expected and measured, of what is done
    results = []
    for i, m in enumerate(measurements):
        path, own = folder / f"{m.id}.json", sha256_json({**key, "machine": cpu_name(), "id": m.id})
        label = f"[{i + 1}/{len(measurements)}] {m.title}"
        if (kept := _kept(path, own)) is not None:
            say(f"{label}: kept")
            results.append(kept)
            left.pop(m.id)
            continue
        factor = spent / told if told else 1.0
        say(f"{label}; about {_minutes(factor * sum(left.values()))} to go")
        result = measure(m, request)
        told, spent = told + left.pop(m.id), spent + result["seconds"]
        if result["problem"]:
            say(f"    failed: {result['problem']}")
        else:
            write_json(path, {"key": own, "result": result})
        results.append(result)
    return results


def measure(m: Measurement, request: Request) -> Result:
    """Return the result of one measurement. Whatever it raises is the result's `problem`, beside what it had by then.

    Somebody reads the page for the other measurements: one that fails never ends the report.
    """
    series: list[Series] = []
    found, start = "", time.perf_counter()
    try:
        for s in m.run(request):
            series.append(s)
        if not series:
            found = "nothing was measured"
    except UserError as e:
        found = str(e)
    except Exception as e:
        traceback.print_exc()
        found = f"{type(e).__name__}: {e}"
    texts = ("id", "group", "title", "approximation", "exact", "reason", "x", "held_by")
    return {
        **{name: getattr(m, name) for name in texts},
        "y": list(m.y),
        "cost": m.cost or m.x,
        "error": m.error or m.y[0],
        "columns": [asdict(c) for c in m.columns],
        "series": [{"name": s.name, "points": [_point(p, m) for p in s.points]} for s in series],
        "seconds": time.perf_counter() - start,
        "measured": utc_now(),
        "commit": harness()["commit"],
        "problem": found,
    }


def measured_from_to(results: Sequence[Result]) -> tuple[str, str]:
    """Return when the first of the results began and the last ended, those that were kept among them."""
    ends = [datetime.fromisoformat(r["measured"]) for r in results]
    begins = [end - timedelta(seconds=r["seconds"]) for end, r in zip(ends, results, strict=True)]
    return utc(min(begins)), utc(max(ends))


def _point(p: Point, m: Measurement) -> dict[str, Any]:
    """Return a point with a value for each column; JSON has no infinity and no NaN."""
    values = {c.id: p.values.get(c.id) for c in m.columns}
    finite = {k: None if v is None or not math.isfinite(v) else float(v) for k, v in values.items()}
    return {"name": p.name, "role": p.role, "values": finite}


def _kept(path: Path, key: str) -> Result | None:
    """Return the result in a file, if it is of the same key."""
    if not path.is_file():
        return None
    try:
        content = read_json(path, "a measurement of the report")
    except UserError:  # a damaged file is measured again
        return None
    result: Result | None = content.get("result")
    return result if content.get("key") == key else None


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


def in_order(measurements: Iterable[Measurement]) -> list[Measurement]:
    """Return measurements by their groups. Raises ValueError for one id twice, and for a group that is not known."""
    found = sorted(measurements, key=lambda m: GROUPS.index(m.group))
    ids = [m.id for m in found]
    if twice := {i for i in ids if ids.count(i) > 1}:
        raise ValueError(f"measurements with one id: {', '.join(sorted(twice))}")
    return found
