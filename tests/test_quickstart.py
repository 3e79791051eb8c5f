"""The notebook of the quickstart runs, and the cells give what a reader expects."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

NOTEBOOK = Path(__file__).resolve().parents[1] / "examples" / "quickstart.ipynb"


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
    # That each fit has a process of its own is no matter of the notebook, and takes half of its time.
    (run,) = (cell for cell in notebook.cells if cell.source.startswith('main("run-benchmark '))
    run.source = run.source.replace(" --out ", " --in-process --out ")
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
