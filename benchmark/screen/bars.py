"""Bars of progress with the time left: on a terminal by rich, in a notebook as HTML, elsewhere none."""

from __future__ import annotations

import time
from collections.abc import Callable
from html import escape
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn
from rich.text import Text

_NOTEBOOK_EVERY_S = 0.2  # between two images of the bars
_FEW = 20  # steps; of more than that the first alone tells too little of the others


class Pace:
    """Estimates the time left by the pace since the first step that ended: what comes before it is done once.

    >>> seconds = iter([0.0, 30.0, 32.0, 33.0])
    >>> pace = Pace(lambda: next(seconds))
    >>> pace.at(1, 10), pace.at(2, 10)  # the first step loads something for 30 s, the second takes 2 s
    (None, None)
    >>> pace.left()  # 8 steps, since one second
    15.0
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock, self._begun = clock, clock()
        self._first: tuple[float, float] | None = None  # done, when
        self._last = (0.0, 0.0, 0.0)  # done, total, when

    def at(self, done: float, total: float) -> None:
        """Take note of `done` steps of `total`; fewer than before begin another stage."""
        now = self._clock()
        if done < self._last[0]:
            self._first, self._begun = None, now
        if self._first is None and done > 0:
            self._first = done, now
        self._last = done, total, now

    def left(self) -> float | None:
        """Return the seconds left; None before the first step has ended, of many steps before the second."""
        if self._first is None:
            return None
        (first, since), (done, total, then) = self._first, self._last
        if done == first and total > _FEW * done:
            return None
        a_step = (then - since) / (done - first) if done > first else (then - self._begun) / done
        return max(0.0, a_step * (total - done) - (self._clock() - then))


def seconds_text(seconds: float) -> str:
    """Return a duration as people read it.

    >>> seconds_text(8.2), seconds_text(754.0), seconds_text(7500.0)
    ('8 s', '12 min 34 s', '2 h 5 min')
    """
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes = whole // 60
    return f"{minutes} min {whole % 60} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def left_text(seconds: float | None) -> str:
    """Return the time left in words, empty where it is not known."""
    return "" if seconds is None else f"about {seconds_text(seconds)} left"


class _Left(ProgressColumn):
    """The time left, of a task that has a `pace`."""

    max_refresh = 0.5

    def render(self, task: Task) -> Text:
        pace = task.fields.get("pace")
        return Text(left_text(pace.left() if pace and not task.finished else None))


class NotebookBars(Progress):
    """The same bars as HTML below a cell of a notebook."""

    _handle: Any = None
    _shown = 0.0

    def start(self) -> None:
        """Show the bars."""
        from IPython.display import HTML, display

        self._handle = display(HTML(self.html()), display_id=True)  # type: ignore[no-untyped-call]

    def stop(self) -> None:
        """Show the last state."""
        self._show()
        self._handle = None

    def refresh(self) -> None:
        """Show the state, where the last one is some time ago."""
        if time.perf_counter() - self._shown > _NOTEBOOK_EVERY_S:
            self._show()

    def update(self, *args: Any, **kwargs: Any) -> None:
        """Change a task, as rich does."""
        super().update(*args, **kwargs)
        self.refresh()

    def _show(self) -> None:
        if self._handle is not None:
            from IPython.display import HTML

            self._shown = time.perf_counter()
            self._handle.update(HTML(self.html()))  # type: ignore[no-untyped-call]

    def html(self) -> str:
        """Return the bars of all tasks."""
        return "".join(
            bar_html(t.description, t.completed, t.total, _Left().render(t).plain) for t in self.tasks if t.visible
        )


def bar_html(title: str, done: float, total: float | None, left: str) -> str:
    """Return a bar as HTML; one without `total` only moves."""
    value = "" if total is None else f'value="{done:g}" max="{max(total, 1):g}"'
    count = "" if total is None else f" {done:g}/{total:g}"
    return f"<div><progress {value}></progress> {escape(title)}{count} {escape(left)}</div>"


def make_bars(console: Console, transient: bool = False) -> Progress:
    """Return bars for a console; tasks that have a field `pace` show the time left."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        _Left(),
    )
    if console.is_jupyter:
        return NotebookBars(*columns, console=console)
    return Progress(*columns, console=console, transient=transient, disable=not console.is_terminal)
