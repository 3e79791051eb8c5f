import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from spike4dgs.studies.kit.measurement import MS, Column, Measurement, Point, Request, Series
from spike4dgs.studies.kit.runner import in_order, measure, measure_all

GROUP = "Images from spikes"
ERROR = Column("error", "error, radiance")


def request(tmp_path: Path) -> Request:
    return Request("tiny", 3, lambda: tmp_path)


def measured(id: str, run: Any, **changes: Any) -> Measurement:
    texts = {"group": GROUP, "title": f"title of {id}", "approximation": "less", "exact": "all", "reason": "because"}
    return Measurement(id, **texts | {"columns": (MS, ERROR), "x": "ms", "y": ("error",), "run": run} | changes)


def good(request: Request) -> Iterator[Series]:
    points = (Point("all", {"ms": 9.0, "error": 0.0}, "exact"), Point("less", {"ms": 2, "error": 1e-3}, "chosen"))
    yield Series(f"seed {request.seed}", points)


def breaks(request: Request) -> Iterator[Series]:
    yield from good(request)
    raise RuntimeError("out of luck")


def test_a_result_has_every_value_and_json_can_hold_it(tmp_path: Path) -> None:
    def odd(request: Request) -> Iterator[Series]:
        yield Series("s", (Point("p", {"ms": math.inf, "error": math.nan}), Point("q", {"ms": 1})))

    result = measure(measured("a", odd), request(tmp_path))
    assert [p["values"] for p in result["series"][0]["points"]] == [
        {"ms": None, "error": None},
        {"ms": 1.0, "error": None},
    ]
    assert result["problem"] == "" and result["cost"] == "ms" and result["error"] == "error"
    json.dumps(result, allow_nan=False)


def test_what_fails_is_told_beside_what_was_measured_and_ends_nothing(tmp_path: Path, capsys) -> None:
    lines: list[str] = []
    ms = [measured("bad", breaks), measured("empty", lambda r: ()), measured("good", good)]
    results = measure_all(ms, request(tmp_path), tmp_path / "m", {}, lines.append)
    assert [r["problem"] for r in results] == ["RuntimeError: out of luck", "nothing was measured", ""]
    assert results[0]["series"] == results[2]["series"]
    assert "    failed: RuntimeError: out of luck" in lines and lines[-1] == "[3/3] title of good"
    assert [p.name for p in (tmp_path / "m").iterdir()] == ["good.json"], "a failed one is measured again"
    assert "Traceback" in capsys.readouterr().err


def test_a_report_goes_on_where_it_was(tmp_path: Path) -> None:
    calls: list[str] = []

    def counted(request: Request) -> Iterator[Series]:
        calls.append("again")
        yield from good(request)

    def report(key: dict[str, Any]) -> list[dict[str, Any]]:
        return measure_all([measured("a", counted)], request(tmp_path), tmp_path / "m", key, lambda line: None)

    first = report({"seed": 3})
    assert report({"seed": 3}) == first and len(calls) == 1
    report({"seed": 4})
    assert len(calls) == 2, "another seed is another measurement"
    (tmp_path / "m/a.json").write_text('{"key":')
    report({"seed": 4})
    assert len(calls) == 3, "a damaged file is measured again"


def test_the_order_is_that_of_the_page() -> None:
    ms = [measured("a", good), measured("b", good, group="Rasterizer"), measured("c", good)]
    assert [m.id for m in in_order(ms)] == ["b", "a", "c"]
    with pytest.raises(ValueError, match="one id: a"):
        in_order([ms[0], ms[0]])
