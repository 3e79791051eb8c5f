"""Run a study: measure one after the other, then write the record, the tables and the page.

Each result is a file at once, so that a killed study resumes.
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.environment import command_line, cpu_name, environment, harness, utc, utc_now
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import read_json, sha256_json, write_json
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.studies.kit.checkout import code_now
from spike4dgs.studies.kit.measurement import GROUPS, Measurement, Point, Request, Series
from spike4dgs.studies.kit.timing import write_csv

Result = dict[str, Any]  # a measurement of speed_error.schema.json
FORMAT = "spike4dgs-speed-error/1"


def run_study(
    measurements: Sequence[Measurement], request: Request, out: Path, options: dict[str, Any], again: bool = False
) -> int:
    """Measure, and write OUT/index.html, OUT/speed_error.json and OUT/measurements/ID.csv; return 1 if one failed.

    What OUT has of the same `options`, request, code and machine is kept, unless it is measured `again`.
    """
    from spike4dgs.studies.kit.page import write_page_of

    shared: dict[str, Any] = {"size": request.size, "seed": request.seed, "device": "cpu"}
    folder = out / "measurements"
    for m in measurements if again else ():
        (folder / f"{m.id}.json").unlink(missing_ok=True)
    key = {**shared, **options, "code": code_now()}
    results = measure_all(measurements, request, folder, key, _say)
    started, finished = measured_from_to(results)
    report = {
        "format": FORMAT, **shared, "started": started, "finished": finished, "command": command_line(),
        "harness": harness(), "environment": environment("cpu"), "measurements": results,
    }  # fmt: skip
    check_schema(report, load_schema("spike4dgs.studies.kit", "speed_error.schema.json"), "the report", "report this")
    write_json(out / "speed_error.json", report)
    for r in results:
        rows = [[s["name"], p["name"], p["role"], *p["values"].values()] for s in r["series"] for p in s["points"]]
        write_csv(folder / f"{r['id']}.csv", ["input", "setting", "role", *(c["title"] for c in r["columns"])], rows)
    write_page_of(out / "index.html", report)
    failed = [r["id"] for r in results if r["problem"]]
    _say(f"page: {out / 'index.html'}\nJSON: {out / 'speed_error.json'}")
    if failed:
        _say(f"failed, see the page: {', '.join(failed)}")
    return 1 if failed else 0


def _say(line: str) -> None:
    print(line, flush=True)


def measure_all(
    measurements: Sequence[Measurement], request: Request, folder: Path, key: dict[str, Any], say: Callable[[str], None]
) -> list[Result]:
    """Return a result for each measurement, failed ones too. Files FOLDER/ID.json of the same `key` are kept."""
    results = []
    for i, m in enumerate(measurements, start=1):
        path, own = folder / f"{m.id}.json", sha256_json({**key, "machine": cpu_name(), "id": m.id})
        result = _kept(path, own)
        say(f"[{i}/{len(measurements)}] {m.title}{': kept' if result else ''}")
        if result is None:
            result = measure(m, request)
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
        "cost": m.x,
        "error": m.y[0],
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
    try:
        content = read_json(path, "a measurement of the report")
    except UserError:  # no file, or a damaged one
        return None
    result: Result | None = content.get("result")
    return result if content.get("key") == key else None


def in_order(measurements: Iterable[Measurement]) -> list[Measurement]:
    """Return measurements by their groups. Raises ValueError for one id twice, and for a group that is not known."""
    found = sorted(measurements, key=lambda m: GROUPS.index(m.group))
    ids = [m.id for m in found]
    if twice := {i for i in ids if ids.count(i) > 1}:
        raise ValueError(f"measurements with one id: {', '.join(sorted(twice))}")
    return found
