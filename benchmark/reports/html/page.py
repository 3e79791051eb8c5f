"""The parts of a report's page. Every text is escaped where it enters; what a function returns is HTML."""

from __future__ import annotations

import base64
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.files import write_text
from spike4dgs.benchmark.reports.html.style import STYLE


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
