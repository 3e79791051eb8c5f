import re
from pathlib import Path
from typing import Any

from devtools import Page

from spike4dgs.studies.kit.page import write_page_of

GROUP = "Images from spikes"
TITLES = {"share": "share, %", "ms": "time, ms", "error": "error, radiance"}
COLUMNS = [{"id": column, "title": title, "log": True} for column, title in TITLES.items()]


def result(id: str, series: list[Any], **changes: Any) -> dict[str, Any]:
    texts = {"approximation": "less", "exact": "all", "reason": "it is <enough>", "held_by": "tests/x.py"}
    axes = {"x": "ms", "y": ["error"], "cost": "ms", "error": "error"}
    made = {"id": id, "group": GROUP, "title": f"title of {id}", "columns": COLUMNS, "series": series, "problem": ""}
    return {**made, **texts, **axes, **changes}


def points(*rows: tuple[str, str, float | None, float | None]) -> list[dict[str, Any]]:
    return [{"name": n, "role": r, "values": {"share": 5.0, "ms": ms, "error": e}} for n, r, ms, e in rows]


def page(tmp_path: Path, *results: dict[str, Any]) -> str:
    machine = {"cpu": "a CPU, 2 cores", "gpu": None, "python": "3.11", "platform": "Linux", "packages": {"numpy": "2"}}
    harness = {"version": "0", "commit": "abc", "dirty": True}
    times = {"started": "then", "finished": "now"}
    report = {"size": "tiny", "seed": 3, "device": "cpu", **times, "command": "spike4dgs x"}
    write_page_of(tmp_path / "i.html", {**report, "environment": machine, "harness": harness, "measurements": results})
    return (tmp_path / "i.html").read_text()


def summary_rows(html: str) -> list[list[str]]:
    part = html[html.index('id="summary"') : html.index('id="images-from-spikes"')]
    rows = re.findall(r"<tr>(.*?)</tr>", part.partition("<tbody>")[2], re.DOTALL)
    return [[re.sub("<[^>]+>", "", cell) for cell in re.findall(r"<td.*?</td>", row)] for row in rows]


def test_the_summary_compares_the_chosen_point_with_its_exact_twin(tmp_path: Path) -> None:
    usual = [{"name": "s", "points": points(("all", "exact", 90.0, 0.0), ("less", "chosen", 3.0, 2e-3))}]
    grows = [{"name": "s", "points": points(("", "", 3.0, None))}]
    html = page(tmp_path, result("a", usual), result("c", grows, exact="", x="share"))
    assert summary_rows(html) == [["title of a", "less", "3", "90", "30", "time, ms", "0.002", "error, radiance"]]
    assert 'href="#title-of-a"' in html and 'id="title-of-a"' in html
    assert "a CPU, 2 cores" in html and "abc, with changes" in html and "it is &lt;enough&gt;" in html


def test_a_failed_measurement_is_on_the_page_with_what_it_had(tmp_path: Path) -> None:
    some = [{"name": "s", "points": points(("all", "exact", 90.0, 0.0))}]
    html = page(tmp_path, result("a", some, problem="out of <luck>"), result("b", [], problem="no file"))
    assert html.count("Failed: title of a: out of &lt;luck&gt;") == 1 and html.count("Failed: out of &lt;luck&gt;") == 1
    assert "no file" in html and html.count("<svg") == 1


def test_the_page_opens_without_an_error_on_a_phone(tmp_path: Path, empty_page: Page) -> None:
    many = points(*((f"setting {i}", "chosen" if i == 3 else "", 1.5**i, 2.0**-i) for i in range(20)))
    page(tmp_path, result("a", [{"name": f"series {k}", "points": many} for k in range(9)]))
    empty_page.show((tmp_path / "i.html").as_uri(), "document.readyState == 'complete'", width=390)
    assert empty_page.errors() == []
    assert empty_page.value("document.documentElement.scrollWidth") <= 390
    assert empty_page.value("document.querySelectorAll('svg .ring').length") == 9
    assert empty_page.value("document.querySelector('details').open") is False, "long tables are folded"
