"""The ten lines of Python that README and the docs show, and those of `import spike4dgs`, give what they say."""

from __future__ import annotations

import doctest
import re
from pathlib import Path

import pytest

import spike4dgs
from spike4dgs.cli import main

TEXT = (Path(__file__).resolve().parents[1] / "docs/snippets/ten_lines.md").read_text(encoding="utf-8")


def test_there_are_at_most_ten() -> None:
    assert TEXT.startswith("```python\n") and TEXT.endswith("\n```\n") and TEXT.count("```") == 2
    assert len(re.findall(r"^(>>>|\.\.\.) ", TEXT, re.MULTILINE)) <= 10


@pytest.mark.slow
@pytest.mark.usefixtures("no_images")
def test_they_give_what_they_say(tiny_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the scene of `make-dataset car --profile tiny` and a model of `run-benchmark`, fitted with a few steps."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").symlink_to(tiny_data)
    fit = ["--methods", "tfp+static", "--budget", "0.01", "--metrics", "psnr", "--device", "cpu", "--in-process"]
    assert main(["run-benchmark", "data/car-0-tiny", *fit, "--out", "runs/tiny"]) == 0
    block = TEXT.removeprefix("```python\n").removesuffix("```\n")
    test = doctest.DocTestParser().get_doctest(block, {}, "ten_lines", "docs/snippets/ten_lines.md", 0)
    result = doctest.DocTestRunner().run(test)
    assert result.attempted == len(test.examples) == 10 and not result.failed
    front = doctest.testmod(spike4dgs, optionflags=doctest.ELLIPSIS)
    shown = {name for name in spike4dgs.__all__ if f"spike4dgs.{name}(" in (spike4dgs.__doc__ or "")}
    assert shown == set(spike4dgs.__all__) and front.attempted > len(shown) and not front.failed
