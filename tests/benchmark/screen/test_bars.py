"""Bars: the time left, and what a notebook shows."""

import io
import sys
import types

import pytest
from rich.console import Console

from spike4dgs.benchmark.runs import display
from spike4dgs.benchmark.runs.display import RunDisplay
from spike4dgs.benchmark.screen import bars, fit_progress
from spike4dgs.benchmark.screen.bars import NotebookBars, Pace, left_text, make_bars
from spike4dgs.benchmark.screen.fit_progress import FitProgress


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_even_steps_after_a_slow_first_one_have_an_exact_estimate_at_once() -> None:
    clock = Clock()
    pace = Pace(clock)
    assert pace.left() is None and left_text(None) == ""
    for done in range(1, 11):
        clock.now = 40.0 + 3.0 * (done - 1)
        pace.at(done, 10)
        if done > 1:
            assert pace.left() == 3.0 * (10 - done)
    clock.now += 100.0
    assert pace.left() == 0.0


def test_the_first_of_many_steps_gives_no_estimate_alone() -> None:
    """A renderer compiles for a minute before its first key frame: 401 of them take no hours."""
    clock = Clock()
    pace = Pace(clock)
    for now, done, left in ((60.0, 1, None), (62.0, 2, 2.0 * 399)):
        clock.now = now
        pace.at(done, 401)
        assert pace.left() == left


def test_a_step_that_lasts_lets_the_estimate_count_down() -> None:
    clock = Clock()
    pace = Pace(clock)
    for now, done in ((1.0, 1), (2.0, 2)):
        clock.now = now
        pace.at(done, 12)
    clock.now = 5.0
    assert pace.left() == 7.0


def test_a_second_stage_of_as_many_steps_has_an_estimate_of_its_own() -> None:
    clock = Clock()
    pace = Pace(clock)
    for now, done, left in ((50.0, 5, 50.0), (60.0, 0, None), (61.0, 1, 9.0), (63.0, 2, 16.0)):
        clock.now = now
        pace.at(done, 10)
        assert pace.left() == left


def run_cells(monkeypatch, cells: list[tuple[str, float, bool]], typical_s=None) -> list[float | None]:
    """Run cells of (method, seconds, fitted); return the estimates after each but the last."""
    clock, estimates = Clock(), []
    monkeypatch.setattr(display.time, "perf_counter", clock)
    shown = RunDisplay(Console(file=io.StringIO()), len(cells), [method for method, *_ in cells], typical_s)
    with shown:
        for method, seconds, fitted in cells:
            with shown.cell(f"{method} on a scene") as cell:
                if fitted:
                    cell.progress(0, 1, "images")
                clock.now += seconds
            estimates.append(shown.left())
    return estimates[:-1]


def test_cells_left_take_as_long_as_those_of_their_method(monkeypatch) -> None:
    quick, slow = ("quick", 2.0, True), ("slow", 90.0, True)
    assert run_cells(monkeypatch, [quick, slow, quick, slow, slow]) == [8.0, 182.0, 180.0, 90.0]
    kept, fitted = ("a", 0.1, False), ("a", 60.0, True)
    assert run_cells(monkeypatch, [kept, kept, fitted, fitted, fitted])[2:] == [120.0, 60.0], "what is kept is no guide"


def test_cells_of_other_methods_take_what_their_typical_seconds_say(monkeypatch) -> None:
    typical_s = {"none": 0.0, "quick": 10.0, "slow": 60.0}
    cells = [("none", 0.0, False), ("quick", 20.0, True), ("slow", 100.0, True), ("slow", 100.0, True)]
    after_none, after_quick, after_slow = run_cells(monkeypatch, cells, typical_s)
    assert after_none == 15.0 + 65.0 + 65.0  # nothing was measured; 5 s for what is not the fit
    assert after_quick == pytest.approx(20 / 15 * (65.0 + 65.0))  # this machine takes a third longer
    assert after_slow == 100.0  # as the one before
    cells = [("quick", 20.0, True), ("unknown", 30.0, True), ("slow", 100.0, True)]
    assert run_cells(monkeypatch, cells, typical_s) == pytest.approx([20.0 + 20 / 15 * 65.0, 20 / 15 * 65.0])
    cells = [("none", 4.0, True), ("slow", 60.0, True)]
    assert run_cells(monkeypatch, cells, typical_s) == pytest.approx([4 / 5 * 65.0])  # not 4 s over no second


def test_a_cell_of_a_known_method_does_not_end_with_its_stage(monkeypatch) -> None:
    clock = Clock()
    monkeypatch.setattr(display.time, "perf_counter", clock)
    with RunDisplay(Console(file=io.StringIO()), 2, ["a", "a"]) as shown:
        with shown.cell("first") as cell:
            cell.progress(0, 1, "images")
            clock.now += 50.0
        with shown.cell("second") as cell:
            for done in range(1, 3):
                clock.now += 1.0
                cell.progress(done, 4, "images")
            assert shown.left() == 48.0  # two steps of a stage are left, and the rest of the fit


def test_a_terminal_has_bars_and_a_file_has_none() -> None:
    assert make_bars(Console(file=io.StringIO())).disable
    assert not make_bars(Console(file=io.StringIO(), force_terminal=True)).disable


def test_a_notebook_has_bars_of_html(monkeypatch) -> None:
    pytest.importorskip("IPython")
    made, shown = NotebookBars(console=Console(file=io.StringIO())), []
    made._handle = types.SimpleNamespace(update=lambda html: shown.append(html.data))
    monkeypatch.setattr(bars, "_NOTEBOOK_EVERY_S", 0.0)
    task = made.add_task("images of <car>", total=8)
    made.update(task, completed=2)
    made.stop()
    assert '<progress value="2" max="8"></progress> images of &lt;car&gt; 2/8' in shown[-1]


def test_a_fit_in_a_notebook_shows_one_bar_that_ends_full(monkeypatch) -> None:
    shown: list[str] = []

    def update(html) -> None:
        shown.append(html.data)

    def display(html, display_id):
        update(html)
        return types.SimpleNamespace(update=update)

    fake = types.SimpleNamespace(HTML=lambda data: types.SimpleNamespace(data=data), display=display)
    monkeypatch.setattr(fit_progress, "in_notebook", lambda: True)
    monkeypatch.setitem(sys.modules, "IPython.display", fake)
    progress = FitProgress()
    progress(0, 1, "images")
    progress(10, 30, "loss 0.1")
    progress(30, 30, "loss 0.02")
    assert "<progress ></progress> images" in shown[0]
    assert '<progress value="30" max="30"></progress> loss 0.02 30/30' in shown[-1]


def test_a_fit_without_terminal_and_notebook_shows_nothing(capsys) -> None:
    FitProgress()(30, 30, "loss 0.02")
    assert capsys.readouterr() == ("", "")
