"""The docs say what is true: links resolve, named places exist, every page is in the site, the README is short."""

import ast
import functools
import importlib.util
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tyro
import yaml
from PIL import Image

from spike4dgs.benchmark.method import FitRequest, check_protocol
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.cli import COMMANDS
from spike4dgs.cli.dispatch import load

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "examples" / "README.md", *DOCS.rglob("*.md")])
TEN_LINES = DOCS / "snippets" / "ten_lines.md"
README_WORDS = 1200
_FENCE = re.compile(r"^ *```(\w*)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)


def named(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def prose(path: Path) -> str:
    """The text of a page without code blocks and inline code."""
    return re.sub(r"`[^`\n]+`", "", _FENCE.sub("", path.read_text()))


def change_table() -> list[tuple[str, str]]:
    """(what to change, where) of CONTRIBUTING's table; a row that names two places gives two pairs."""
    table = (ROOT / "CONTRIBUTING.md").read_text().partition("| to change | go to |\n")[2].partition("\n\n")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[1:]]
    return [(row[0], place) for row in rows for place in re.findall(r"`([^`]+)`", row[1])]


def defined_names(path: Path) -> set[str]:
    names = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        names |= {t.id for t in targets if isinstance(t, ast.Name)}
    return names


def anchors(path: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and MkDocs make them."""
    titles = re.findall(r"^#+ (.+)$", _FENCE.sub("", path.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


@pytest.mark.parametrize("figure", ["conditions", "uncalibrated"])
def test_figures_are_drawn_from_the_records(figure: str, tmp_path: Path) -> None:
    """The script is no part of the package, so nothing else imports it."""
    spec = importlib.util.spec_from_file_location("result_figures", DOCS / "result_figures.py")
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.FIGURES[figure](tmp_path / "figure.webp")
    with Image.open(tmp_path / "figure.webp") as image:
        assert image.format == "WEBP" and np.ptp(np.asarray(image.convert("L"))) > 200


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().split()) <= README_WORDS


def test_the_readme_has_the_ten_lines() -> None:
    assert TEN_LINES.read_text().strip() in (ROOT / "README.md").read_text()


def test_the_change_table_covers_fifteen_requests_and_names_what_exists() -> None:
    assert len({what for what, _ in change_table()}) >= 15
    for what, place in change_table():
        name, _, member = place.partition("::")
        assert (ROOT / name).is_file(), f"{what}: no file {name}"
        if member:
            assert member in defined_names(ROOT / name), f"{what}: {name} defines no {member}"


def test_relative_links_resolve() -> None:
    links = [(page, target) for page in PAGES for target in re.findall(r"\]\(([^)\s]+)\)", prose(page))]
    for page, target in links:
        name, _, anchor = target.partition("#")
        if "://" in name or name.startswith("mailto:"):
            continue
        found = page.parent / name if name else page
        assert found.exists(), f"{named(page)} links to {target}"
        if page.is_relative_to(DOCS):
            assert found.resolve().is_relative_to(DOCS), f"{named(page)} links out of the site, to {target}"
        if anchor and found.suffix == ".md" and "<!-- include" not in found.read_text():
            assert anchor in anchors(found), f"{named(page)} links to {target}"


def test_named_files_exist() -> None:
    """Paths of source files in prose and tables, such as `benchmark/files.py`."""
    path = r"`((?:benchmark|generators|method|baselines|leaderboard|tests|examples)/[\w/.]+\.\w+)`"
    for page in PAGES:
        for name in re.findall(path, _FENCE.sub("", page.read_text())):
            placeholder = re.search("NAME|DATASET|METHOD", name)
            assert placeholder or (ROOT / name).exists(), f"{named(page)} names {name}"


def test_python_blocks_parse() -> None:
    for page in PAGES:
        for language, code in _FENCE.findall(page.read_text()):
            if language == "python" and not code.lstrip().startswith(">>>"):
                ast.parse(code, named(page))


def test_every_page_is_in_the_site() -> None:
    def files(item: object) -> list[str]:
        if isinstance(item, str):
            return [item]
        values = item.values() if isinstance(item, dict) else item
        return [name for value in values for name in files(value)]  # type: ignore[union-attr]

    nav = files(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])
    pages = {p.relative_to(DOCS).as_posix() for p in DOCS.rglob("*.md") if TEN_LINES.parent not in p.parents}
    assert sorted(nav) == sorted(pages)


def test_the_commands_are_all_described() -> None:
    text = (DOCS / "commands.md").read_text()
    missing = [name for name in COMMANDS if f"`{name}`" not in text]
    assert not missing


def documented_commands() -> list[tuple[str, list[str]]]:
    """The page and the words of each command line in a shell block, without the `spike4dgs` before them."""
    found = []
    for page in PAGES:
        for language, code in _FENCE.findall(page.read_text()):
            lines = re.sub(r"\\\n", " ", re.sub(r"\s#.*$", "", code, flags=re.M)).replace("\n", " ; ")
            words = shlex.shlex(lines if language == "sh" else "", posix=True, punctuation_chars=True)
            words.whitespace_split = True
            command: list[str] | None = None
            before = ";"
            for word in words:
                if word.endswith("spike4dgs") and re.fullmatch("[;|&()]+|do|.*=.*", before):
                    found.append((named(page), command := []))
                elif re.fullmatch("[;|&<>()]+", word):
                    command = None
                elif command is not None:
                    command.append(word)
                before = word
    return found


def test_the_command_lines_of_the_pages_are_taken(capsys: pytest.CaptureFixture[str]) -> None:
    commands = documented_commands()
    assert len(commands) > 150
    for page, words in commands:
        verbs = 2 if " ".join(words[:2]) in COMMANDS else 1
        name, arguments = " ".join(words[:verbs]), words[verbs:]
        if name == "--help":
            continue
        taken = functools.wraps(load(name))(lambda *_, **__: None)
        try:
            tyro.cli(taken, args=arguments)
        except SystemExit as e:
            assert e.code == 0, f"{page}: spike4dgs {' '.join(words)}\n{capsys.readouterr().err}"


@pytest.mark.parametrize("room", ["benchmark", "generators", "method", "baselines", "leaderboard"])
def test_every_exported_module_is_in_the_reference(room: str) -> None:
    source = (ROOT / room / "__init__.py").read_text()
    exports = re.findall(rf"^    from (spike4dgs\.{room}\.[\w.]+) import", source, re.M)
    pages = [page.read_text() for page in (DOCS / "api").rglob("*.md")]
    shown = [module for text in pages for module in re.findall(r"^<!-- api (\S+) -->$", text, re.M)]
    assert exports
    assert [module for module in exports if shown.count(module) != 1] == []


def test_the_citation_is_complete() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors", "version", "license"} <= citation.keys()
    paper = citation["preferred-citation"]
    assert {"type", "title", "authors", "year"} <= paper.keys()
    assert all({"family-names", "given-names"} <= a.keys() or a == {"name": "and others"} for a in paper["authors"])


def test_the_tutorials_method_fits_and_renders(small_scene: Path) -> None:
    code = next(c for _, c in _FENCE.findall((DOCS / "tutorial.md").read_text()) if c.startswith("# my_methods.py"))
    names: dict[str, Any] = {}
    exec(code, names)
    scene = open_scene(small_scene)
    (method,) = names["METHODS"].values()
    check_protocol(method, "the tutorial")
    camera = scene.cameras[scene.test[0]]
    image = method.fit(scene.training, FitRequest()).render(camera, 0.0)
    assert image.shape == (camera.height, camera.width)
    assert image.dtype == np.float32
