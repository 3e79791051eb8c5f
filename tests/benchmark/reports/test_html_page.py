import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from devtools import Page

from spike4dgs.benchmark.reports import html_page as page
from spike4dgs.benchmark.reports.html_chart import Axis, Curve, Dot, chart

HOSTILE = '<img src=x onerror="window.hacked=1"></title></style><script>window.hacked=1</script>&'
VOID = {"meta", "link", "img", "br", "line", "circle", "polyline"}


class Balance(HTMLParser):
    """Every tag that opens closes, in order; `words` is the text outside of the style."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.words = ""

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.words += data


def parsed(html: str) -> Balance:
    found = Balance()
    found.feed(html)
    found.close()
    assert not found.open
    return found


def hostile_page(path: Path) -> None:
    curves = [Curve(HOSTILE, (Dot(1.0, 0.0, HOSTILE), Dot(20.0, 1e-3, "b", chosen=True))), Curve("c", (Dot(3.0, 0.1),))]
    parts = [
        page.contents([HOSTILE]),
        page.section(HOSTILE, [page.paragraph(HOSTILE, "bad"), page.bullets([HOSTILE]), page.bullets([])]),
        page.facts([(HOSTILE, HOSTILE)]),
        page.table([HOSTILE, "b"], [[HOSTILE, "1"], ["c", "2"]], marked=[1]),
        page.grid([page.figure(chart(curves, Axis(HOSTILE), Axis("y", log=False), HOSTILE), HOSTILE)]),
        page.figure(page.image(b"\x89PNG", HOSTILE), HOSTILE),
        page.folded(HOSTILE, [page.paragraph("inside `code`")]),
    ]
    page.write_page(path, HOSTILE, parts)


def test_every_text_is_escaped_and_every_tag_closes(tmp_path: Path) -> None:
    hostile_page(tmp_path / "page.html")
    html = (tmp_path / "page.html").read_text()
    assert parsed(html).words.count(HOSTILE) >= 10
    assert "<script" not in html and "<img src=x" not in html
    assert "<code>code</code>" in html and "<ul></ul>" not in html
    assert not re.search(r"(?:src|href)=\"(?:https?:)?//", html), "nothing comes from a network"


def test_columns_are_numbers_but_those_of_words_and_a_marked_row_stands_out() -> None:
    html = page.table(["name", "ms"], [["a", "1"], ["b", "2"]], marked=[1])
    assert html.count('<td class="number">') == 2 and html.count("<td>") == 2
    assert "<tr><td>a</td>" in html and '<tr class="marked"><td>b</td>' in html


def test_the_contents_lead_to_the_sections() -> None:
    title = "Splat: 3 sigma, or 1/255?"
    target = re.search(r'href="#([^"]+)"', page.contents([title]))
    assert target is not None and f'id="{target[1]}"' in page.section(title, [])


@pytest.mark.parametrize("width", [390, 1400])
def test_the_page_opens_from_the_disk_and_fits_the_window(empty_page: Page, tmp_path: Path, width: int) -> None:
    hostile_page(tmp_path / "page.html")
    empty_page.show((tmp_path / "page.html").as_uri(), "document.readyState == 'complete'", width=width)
    bad_image = "ERR_INVALID_URL"  # of bytes that are no PNG
    assert not [e for e in empty_page.errors() if bad_image not in e]
    assert empty_page.value("window.hacked") is None
    assert empty_page.value("document.documentElement.scrollWidth") <= width


def test_the_page_follows_the_readers_colours(empty_page: Page, tmp_path: Path) -> None:
    hostile_page(tmp_path / "page.html")
    seen = []
    for scheme in ("light", "dark"):
        empty_page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        empty_page.show((tmp_path / "page.html").as_uri(), "document.readyState == 'complete'")
        at = "getComputedStyle(document.querySelector('circle:not(.ring)')).fill"
        seen.append((empty_page.value("getComputedStyle(document.body).backgroundColor"), empty_page.value(at)))
    (light, dot), (dark, dark_dot) = seen
    assert light == "rgb(255, 255, 255)" and dark == "rgb(20, 23, 28)" and dot != dark_dot
