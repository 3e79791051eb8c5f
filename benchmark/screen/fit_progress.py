"""Progress of a fit that Python starts: a line on a terminal, a bar in a notebook, nothing elsewhere."""

from __future__ import annotations

import sys
import time
from typing import Any

from spike4dgs.benchmark.screen.bars import Pace, bar_html, left_text

_EVERY_S = 0.2
_LINE = 100  # characters


def in_notebook() -> bool:
    """Return whether a notebook's kernel runs this."""
    python = sys.modules.get("IPython")
    shell = python.get_ipython() if python else None
    return shell is not None and type(shell).__name__ == "ZMQInteractiveShell"


class FitProgress:
    """A receiver of one fit's progress, with the time left; see `benchmark.method.Progress`."""

    def __init__(self) -> None:
        self._pace, self._total, self._shown = Pace(), 0, 0.0
        self._handle: Any = None

    def __call__(self, done: int, total: int, note: str = "") -> None:
        """Show that `done` of `total` steps are done."""
        if total != self._total:
            self._pace, self._total = Pace(), total
        self._pace.at(done, total)
        now, last = time.perf_counter(), done >= total
        if last or now - self._shown > _EVERY_S:
            self._shown = now
            left = "" if last else left_text(self._pace.left())
            if in_notebook():
                self._show(bar_html(note, done, total if done else None, left))
            elif sys.stderr.isatty():
                text = f"{f'{done}/{total} ' if done else ''}{note} {left}"
                print(f"\r{text[:_LINE]:<{_LINE}}", end="\n" if last else "", file=sys.stderr, flush=True)

    def _show(self, html: str) -> None:
        from IPython.display import HTML, display

        if self._handle is None:
            self._handle = display(HTML(html), display_id=True)  # type: ignore[no-untyped-call]
        else:
            self._handle.update(HTML(html))  # type: ignore[no-untyped-call]
