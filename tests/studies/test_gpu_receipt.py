"""`doctor --gpu-receipt`: refused without a GPU in one line; all that needs no CUDA, on the CPU."""

import json
import socket
import tomllib
import warnings
from pathlib import Path

import pytest
import torch

from spike4dgs.benchmark.environment import Missing
from spike4dgs.benchmark.errors import UserError
from spike4dgs.cli import main
from spike4dgs.studies.gpu_receipt import command as module
from spike4dgs.studies.gpu_receipt.command import make_receipt, require_gpu
from spike4dgs.studies.gpu_receipt.costs import operations, waits_told
from spike4dgs.studies.gpu_receipt.device_tests import run_tests

NOTEBOOK = Path(__file__).resolve().parents[2] / "examples" / "gpu_receipt.ipynb"
TESTS = """
import os
import warnings

import pytest


def test_passes():
    warnings.warn("not an error here")


@pytest.mark.skip(reason="no device")
def test_is_skipped():
    pass


def test_fails():
    assert os.environ["CUDA_LAUNCH_BLOCKING"] == "1"
    raise RuntimeError("no kernel in /home/somebody/cache/kernels.nbi\\nand more")
"""


@pytest.mark.skipif(torch.cuda.is_available(), reason="a CUDA device is here")
def test_without_a_gpu_it_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--gpu-receipt", str(tmp_path / "receipt.json")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: --gpu-receipt: expected an NVIDIA GPU, found none that torch ")
    assert error.count("\n") == 1 and not list(tmp_path.iterdir())


def test_a_gpu_whose_kernels_do_not_run_is_refused_with_what_mends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(module, "missing_rasterizer", lambda: Missing("numba-cuda", "none", "install it"))
    with pytest.raises(UserError, match="--gpu-receipt: expected numba-cuda, found none; install it"):
        require_gpu()


def test_a_receipt_of_the_cpu_has_every_part(tmp_path: Path) -> None:
    tests = {"exit_code": 0, "passed": 3, "failed": 0, "skipped": 1, "seconds": 2.5, "failures": []}
    receipt = make_receipt("cpu", tests, gaussians=300, views=2, repeats=2)  # the schema is checked inside
    assert receipt["tests"] == tests and receipt["waits"] == []
    image, step = receipt["timing"]
    assert image["what"] == "render 2 views of 400x250, 300 Gaussians" and "gradients" in step["what"]
    assert all(0 < row["least_ms"] <= row["median_ms"] and row["repeats"] == 2 for row in receipt["timing"])
    assert receipt["operations"] and all(row["ms"] >= 0 and row["calls"] > 0 for row in receipt["operations"])
    text = json.dumps(receipt)
    assert str(Path.home()) not in text and socket.gethostname() not in text and str(Path.cwd()) not in text


def test_the_tests_run_in_another_process_and_are_counted(tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").write_text("[tool.pytest.ini_options]\nfilterwarnings = ['error']\n")
    (tmp_path / "test_it.py").write_text(TESTS)
    found = run_tests(tmp_path, "test_it.py")
    assert (found["exit_code"], found["passed"], found["failed"], found["skipped"]) == (1, 1, 1, 1)
    assert found["failures"] == [{"test": "test_fails", "message": "RuntimeError: no kernel in kernels.nbi"}]
    (tmp_path / "test_it.py").write_text("import os\n\ndef test_dies():\n    os._exit(7)\n")
    found = run_tests(tmp_path, "test_it.py")
    assert (found["exit_code"], found["passed"], found["failures"]) == (7, 0, [])


def test_what_waits_for_the_device_is_told_by_line() -> None:
    def call() -> None:
        for _ in range(3):
            warnings.warn("called a synchronizing CUDA operation (Triggered internally)", stacklevel=1)
        warnings.warn("something else", stacklevel=1)

    (row,) = waits_told(call)
    assert row["count"] == 3 and row["where"].startswith("studies/test_gpu_receipt.py:")


def test_operations_are_those_of_one_call() -> None:
    a = torch.rand(64, 64)
    rows = {row["name"]: row["calls"] for row in operations(lambda: (a @ a) @ a, "cpu")}
    assert rows["aten::mm"] == 2


def test_the_notebook_runs_commands_that_there_are_and_reads_a_receipt(tmp_path: Path, monkeypatch, capsys) -> None:
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    sources = ["".join(cell["source"]) for cell in cells]
    assert not any(cell["outputs"] for cell in cells), "nobody has run it yet"
    commands = [line.split() for source in sources for line in source.splitlines() if line.startswith("!spike4dgs ")]
    assert [words[1:] for words in commands] == [["doctor"], ["doctor", "--gpu-receipt", "receipt.json"]]
    extras = tomllib.loads((NOTEBOOK.parents[1] / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert {"test", "cuda", "cuda12"} <= extras.keys()
    (reader,) = (source for source in sources if "json.loads" in source)
    failed = {"exit_code": 1, "passed": 3, "failed": 2, "skipped": 0, "seconds": 2.5, "failures": []}
    receipt = make_receipt("cpu", failed, gaussians=50, views=1, repeats=1)
    receipt["waits"] = [{"where": "cuda/prepare.py:83", "count": 2}]
    monkeypatch.chdir(tmp_path)
    Path("receipt.json").write_text(json.dumps(receipt))
    exec(compile(reader, NOTEBOOK.name, "exec"), {})
    shown = capsys.readouterr().out
    assert "3 passed, 2 failed" in shown and shown.count(" ms\n") == 2
    assert "a step waits at cuda/prepare.py:83, 2 times" in shown
