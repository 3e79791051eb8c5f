"""The parts of a report's page. Every text is escaped where it enters; what a function returns is HTML."""

from __future__ import annotations

import base64
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.files import write_text

COLORS = 8  # of curves, --c0 to --c7; a further curve starts again, with a dashed line

# The first colours are Okabe and Ito's, which people who are colour-blind tell apart; lighter ones on a dark ground.
STYLE = """
:root {
  color-scheme: light dark; font: 15px/1.5 system-ui, "Segoe UI", Roboto, "Noto Sans", sans-serif;
  --ground: #fff; --panel: #f4f5f7; --line: #d5d8de; --text: #1b1f27; --soft: #59606d; --link: #2454c4;
  --good: #0b6b3a; --bad: #b3261e;
  --c0: #0072b2; --c1: #c75000; --c2: #007a5a; --c3: #a64d85; --c4: #8a6d00; --c5: #3f6f8c;
  --c6: #6a45b8; --c7: #b3123f;
}
@media (prefers-color-scheme: dark) {
  :root {
    --ground: #14171c; --panel: #1d2128; --line: #363c47; --text: #e6e8ec; --soft: #a3aab7; --link: #8ab4ff;
    --good: #63d297; --bad: #ff8a80;
    --c0: #56b4e9; --c1: #ff9d4d; --c2: #3ecf9f; --c3: #e29bc6; --c4: #f0e442; --c5: #a9cbe0;
    --c6: #b9a3ff; --c7: #ff8fa3;
  }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 76rem; padding: 0 1rem 3rem; background: var(--ground); color: var(--text); }
body { overflow-wrap: break-word; }
h1 { font-size: 1.5rem; line-height: 1.25; margin: 1.2rem 0 .3rem; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .4rem; padding-top: .7rem; border-top: 1px solid var(--line); }
h3 { font-size: 1.02rem; margin: 1.4rem 0 .3rem; }
p { margin: .3rem 0 .6rem; max-width: 52rem; } ul { margin: .3rem 0 .6rem; padding-left: 1.2rem; }
a { color: var(--link); } :focus-visible { outline: 3px solid var(--link); outline-offset: 1px; }
code { overflow-wrap: anywhere; font-size: .92em; }
.soft, figcaption, .unit { color: var(--soft); font-size: .88rem; } .good { color: var(--good); }
.bad { color: var(--bad); overflow-wrap: anywhere; }
nav ul { display: flex; flex-wrap: wrap; gap: .1rem 1rem; list-style: none; padding: 0; }
.scroll { overflow-x: auto; margin: .5rem 0 .9rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; }
th, td { padding: .25rem .8rem .25rem 0; text-align: left; border-bottom: 1px solid var(--line); vertical-align: top; }
thead th { vertical-align: bottom; color: var(--soft); font-weight: 600; }
.number { text-align: right; white-space: nowrap; } thead .number { white-space: normal; }
.wide table { min-width: 64rem; } .wide td { max-width: 19rem; } .wide td:first-child { white-space: nowrap; }
tr.marked > * { font-weight: 600; background: var(--panel); }
.facts th { white-space: nowrap; } .facts td { overflow-wrap: anywhere; }
.grid { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 26rem), 1fr)); gap: 1rem 1.5rem; }
figure { margin: 0; min-width: 0; max-width: 38rem; }
img, video { max-width: 100%; height: auto; }
figure svg, figure img { display: block; width: 100%; height: auto; }
.legend { display: flex; flex-wrap: wrap; gap: .1rem .9rem; list-style: none; margin: 0; padding: 0; }
.legend { font-size: .85rem; }
.swatch { display: inline-block; width: .8rem; height: .8rem; border-radius: 50%; margin-right: .3rem; }
svg text { fill: var(--text); font-size: 11px; } svg .axis text, svg .title { fill: var(--soft); }
svg .grid-line { stroke: var(--line); stroke-width: 1; } svg .ring { fill: none; stroke: var(--text); stroke-width: 2; }
svg .halo { paint-order: stroke; stroke: var(--ground); stroke-width: 3px; stroke-linejoin: round; }
svg .dashed { stroke-dasharray: 5 4; }
summary { cursor: pointer; color: var(--link); }
@media (max-width: 40rem) {
  .facts th, .facts td { display: block; border: 0; padding: 0; } .facts td { padding-bottom: .5rem; }
  .facts { width: 100%; }
}
"""


class Html(str):
    """Text that is HTML already: nothing escapes it again."""


def write_page(path: Path, title: str, parts: Iterable[Html]) -> None:
    """Write a page of one file atomically: a head, the title, then the parts."""
    head = (
        f'<meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style>'
        '<link rel="icon" href="data:,">'  # or the browser asks a server for one
    )
    body = "\n".join([f"<h1>{escape(title)}</h1>", *parts])
    write_text(path, f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n{body}\n</body></html>\n')


def text(plain: str) -> Html:
    """Return a text for HTML. Words between backquotes become code; what is HTML stays as it is."""
    if isinstance(plain, Html):
        return plain
    return Html(re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(plain)))


def paragraph(plain: str, kind: str = "") -> Html:
    """Return a paragraph; `kind` is a class of the style, such as soft, good or bad."""
    return Html(f"<p{_class(kind)}>{text(plain)}</p>")


def bullets(items: Iterable[str]) -> Html:
    """Return a list; an empty one is no HTML."""
    lines = "".join(f"<li>{text(item)}</li>" for item in items)
    return Html(f"<ul>{lines}</ul>" if lines else "")


def section(title: str, parts: Iterable[Html], level: int = 2) -> Html:
    """Return a heading with a link's target, then the parts."""
    return Html(f'<h{level} id="{anchor(title)}">{text(title)}</h{level}>\n' + "\n".join(parts))


def contents(titles: Iterable[str]) -> Html:
    """Return links to sections by their titles."""
    links = "".join(f"<li>{link(title, title)}</li>" for title in titles)
    return Html(f'<nav aria-label="Contents"><ul>{links}</ul></nav>')


def link(title: str, words: str) -> Html:
    """Return a link to the section of that title."""
    return Html(f'<a href="#{anchor(title)}">{text(words)}</a>')


def anchor(title: str) -> str:
    """Return the id of a section: its words in lower case, with hyphens."""
    return re.sub(r"\W+", "-", title.lower()).strip("-")


def facts(rows: Iterable[tuple[str, str]]) -> Html:
    """Return a table of names and texts."""
    lines = "".join(f'<tr><th scope="row">{text(name)}</th><td>{text(value)}</td></tr>' for name, value in rows)
    return Html(f'<div class="scroll"><table class="facts"><tbody>{lines}</tbody></table></div>')


def run_facts(report: Mapping[str, Any], options: Sequence[str], when: str) -> Html:
    """Return the table of where, by what, with which `options` of a report's JSON and `when` it was measured."""
    machine, harness = report["environment"], report["harness"]
    commit = harness["commit"] or "unknown (an installed package)"
    return facts(
        [
            ("machine", machine["gpu"] or machine["cpu"]),
            ("commit", f"{commit}{', with changes' if harness['dirty'] else ''}"),
            (", ".join(options), ", ".join(str(report[name]) for name in options)),
            (when, f"{report['started']} to {report['finished']}"),
        ]
    )


def table(
    heads: Sequence[str], rows: Iterable[Sequence[str]], words: Collection[int] = (0,), marked: Collection[int] = ()
) -> Html:
    """Return a table that scrolls by itself where it is wider than the page.

    Columns are numbers, at the right, but those of `words`; rows of `marked` stand out. A cell may be a `link`.
    """
    top = "".join(f'<th scope="col"{_column(i, words)}>{text(head)}</th>' for i, head in enumerate(heads))
    lines = "".join(
        f"<tr{_class('marked' if n in marked else '')}>"
        + "".join(f"<td{_column(i, words)}>{text(cell)}</td>" for i, cell in enumerate(row))
        + "</tr>"
        for n, row in enumerate(rows)
    )
    return Html(f'<div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{lines}</tbody></table></div>')


def wide(content: Html) -> Html:
    """Return a table of sentences, which keeps its width and scrolls by itself on a phone."""
    return Html(f'<div class="wide">{content}</div>')


def figure(picture: Html, caption: str) -> Html:
    """Return a picture with a caption, such as a chart or an `image`."""
    return Html(f"<figure>{picture}<figcaption>{text(caption)}</figcaption></figure>")


def image(png: bytes, what: str) -> Html:
    """Return a PNG inside the page; `what` is said where it cannot be seen."""
    return Html(f'<img alt="{escape(what)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">')


def grid(parts: Iterable[Html]) -> Html:
    """Return parts side by side, as many as the page is wide."""
    return Html('<div class="grid">' + "\n".join(parts) + "</div>")


def folded(summary: str, parts: Iterable[Html]) -> Html:
    """Return parts that a reader opens by their summary."""
    return Html(f"<details><summary>{text(summary)}</summary>\n" + "\n".join(parts) + "</details>")


def _class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""


def _column(i: int, words: Collection[int]) -> str:
    return _class("" if i in words else "number")
