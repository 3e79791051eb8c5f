"""Examples run, and give what they say: in docstrings, the ten lines of README and docs, the quickstart's notebook."""

import doctest
import importlib
import re
from pathlib import Path
from typing import Any

import pytest

import spike4dgs
from spike4dgs.cli import main

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("benchmark", "generators", "method", "baselines", "leaderboard")
TEN_LINES = (ROOT / "docs/snippets/ten_lines.md").read_text(encoding="utf-8")
NOTEBOOK = ROOT / "examples/quickstart.ipynb"
SOURCES = [p for room in ROOMS for p in sorted((ROOT / room).rglob("*.py"))]
MODULES = [
    ".".join(("spike4dgs", *p.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")
    for p in SOURCES
    if re.search(r"^\s*>>> ", p.read_text(encoding="utf-8"), re.MULTILINE)
]


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_give_what_they_say(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert result.attempted, f"{name} has a >>> that doctest does not find"
    assert not result.failed


def test_the_ten_lines_are_at_most_ten() -> None:
    assert TEN_LINES.startswith("```python\n") and TEN_LINES.endswith("\n```\n") and TEN_LINES.count("```") == 2
    assert len(re.findall(r"^(>>>|\.\.\.) ", TEN_LINES, re.MULTILINE)) <= 10


@pytest.mark.slow
@pytest.mark.usefixtures("no_images")
def test_the_ten_lines_give_what_they_say(tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the scene of `make-dataset car --profile tiny` and a model of `run-benchmark`, fitted with a few steps."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").symlink_to(tiny_data)
    fit = ["--methods", "tfp+static", "--budget", "0.01", "--metrics", "psnr", "--device", "cpu", "--in-process"]
    assert main(["run-benchmark", "data/car-0-tiny", *fit, "--out", "runs/tiny"]) == 0
    block = TEN_LINES.removeprefix("```python\n").removesuffix("```\n")
    test = doctest.DocTestParser().get_doctest(block, {}, "ten_lines", "docs/snippets/ten_lines.md", 0)
    result = doctest.DocTestRunner().run(test)
    assert result.attempted == len(test.examples) == 10 and not result.failed
    front = doctest.testmod(spike4dgs, optionflags=doctest.ELLIPSIS)
    shown = {name for name in spike4dgs.__all__ if f"spike4dgs.{name}(" in (spike4dgs.__doc__ or "")}
    assert shown == set(spike4dgs.__all__) and front.attempted > len(shown) and not front.failed


def texts(output: Any) -> str:
    return str(output.get("text") or output.get("data", {}).get("text/plain", ""))


@pytest.mark.slow
def test_the_quickstart_runs_and_shows_cards_bars_and_scores(tiny_data: Path, tmp_path: Path) -> None:
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    (tmp_path / "data").symlink_to(tiny_data)
    notebook = nbformat.read(NOTEBOOK, 4)
    stored = [len(cell.get("outputs", ())) > 0 for cell in notebook.cells if cell.cell_type == "code"]
    assert all(stored), "the site shows the outputs that the notebook holds"
    # Processes of fits, their steps, networks' metrics and sheets are no matter of the notebook, and most of its time.
    for cell in notebook.cells:
        cell.source = cell.source.replace("Budget(0.05)", "Budget(0.01)")
    (run,) = (cell for cell in notebook.cells if cell.source.startswith('main("run-benchmark '))
    run.source = run.source.replace("--budget 0.05 --out ", "--budget 0.01 --metrics psnr --in-process --out ")
    assert "--in-process" in run.source
    assert "by mean PSNR" in "".join(map(texts, run.outputs)), "stored when the command printed what it prints today"
    no_sheets = "from spike4dgs.benchmark.reports import benchmark\nbenchmark._write_images = lambda *_: []\n"
    run.source = no_sheets + run.source
    place = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=600, kernel_name="python3", resources=place).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    cards = [html for output in outputs if (html := output.get("data", {}).get("text/html", ""))]
    for name, images in (("Scene", 4), ("TrainingScene", 3), ("SpikeStream", 1), ("SavedModel", 3), ("FittedModel", 1)):
        (card,) = (html for html in cards if f"<b>{name} " in html)
        assert card.count("<img ") == images
    assert sum("<b>Record " in html for html in cards) == 2 and any("<progress" in html for html in cards)
    (psnr,) = re.findall(r"^'PSNR (\d+\.\d) dB", "\n".join(map(texts, outputs)), re.MULTILINE)
    assert 24 < float(psnr) < 28, "as the ten lines of the README"
