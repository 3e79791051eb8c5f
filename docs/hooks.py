"""MkDocs hooks of the docs site: find the package's sources, include files, list public names."""

from __future__ import annotations

import ast
import importlib
import json
import posixpath
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("benchmark", "generators", "method", "baselines", "leaderboard", "cli", "studies")
SOURCES = ROOT / "build" / "docs" / "spike4dgs"  # links to the rooms, under the name that they are imported by
PAGES = {  # files outside docs/ that have a page on the site
    "CONTRIBUTING.md": "docs/contributing.md",
    "CHANGELOG.md": "docs/changelog.md",
    "examples/README.md": "docs/external_methods.md",
    "method/msdi/README.md": "docs/methods/msdi_card.md",
    "method/image_network/README.md": "docs/methods/images_card.md",
    "method/matching/README.md": "docs/methods/matching_card.md",
    "baselines/images/spk2img/README.md": "docs/methods/spk2img_card.md",
}
_INCLUDE = re.compile(r"^<!-- include (\S+)(?: (\w+))? -->$", re.MULTILINE)
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_NAMES = re.compile(r"^<!-- names of (\w+) -->$", re.MULTILINE)
_RECIPES = re.compile(r"^<!-- recipes of (\w+) -->$", re.MULTILINE)
_NOTEBOOK = re.compile(r"^<!-- notebook (\S+) -->$", re.MULTILINE)
_ANSI = re.compile(r"\x1b\[[0-9;]*m")
_API = re.compile(r"^<!-- api spike4dgs\.(\w+)\.([\w.]+)((?: \w+)*) -->$", re.MULTILINE)


def on_startup(**kwargs: Any) -> None:
    """Link each room into one folder `spike4dgs`, where mkdocstrings looks for it.

    The rooms are top-level folders; only an installation knows that they form one package. mkdocstrings leaves out a
    folder that is not there yet when it is configured.
    """
    SOURCES.mkdir(parents=True, exist_ok=True)
    for name, source in {**{room: ROOT / room for room in ROOMS}, "__init__.py": ROOT / "front/__init__.py"}.items():
        link = SOURCES / name
        if not link.is_symlink() or link.resolve() != source:
            link.unlink(missing_ok=True)
            link.symlink_to(source, target_is_directory=source.is_dir())
    # The folder of scripts is on the path, and its program `spike4dgs` would be taken for the package.
    sys.path[:] = [path for path in sys.path if not (Path(path) / "spike4dgs").is_file()]


def on_config(config: Any, **kwargs: Any) -> None:
    """Link the repository if the package's metadata name it."""
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"].get("urls", {})
    config.repo_url = urls.get("Repository")
    config.repo_name = posixpath.basename(config.repo_url.rstrip("/")) if config.repo_url else None


def on_post_build(config: Any, **kwargs: Any) -> None:
    """Write the leaderboard's page into the site, from the committed entries."""
    from spike4dgs.leaderboard.page.rows import gather
    from spike4dgs.leaderboard.page.site import write_site

    boards, refused = gather(ROOT / "leaderboard", ())
    write_site(Path(config["site_dir"]) / "leaderboard_page", boards, refused, docs="../")


def on_page_markdown(markdown: str, page: Any, **kwargs: Any) -> str:
    """Expand the comments `include FILE [SECTION]`, `notebook FILE`, `names of ROOM`, `recipes of ROOM`, `api NAME`."""
    markdown = _INCLUDE.sub(lambda found: included(found[1], found[2], page.file.src_uri), markdown)
    markdown = _NOTEBOOK.sub(lambda found: notebook(ROOT / found[1]), markdown)
    markdown = _RECIPES.sub(lambda found: recipe_table(found[1]), markdown)
    markdown = _NAMES.sub(lambda found: name_table(found[1]), markdown)
    return _API.sub(lambda found: api(found[1], found[2], tuple(found[3].split())), markdown)


def included(name: str, section: str | None, page: str) -> str:
    """Return a file of the repository, or one `<!-- section NAME -->` of it, with links that work on `page`."""
    text = (ROOT / name).read_text(encoding="utf-8")
    if section:
        _, begin, text = text.partition(f"<!-- section {section} -->\n")
        text, end, _ = text.partition(f"<!-- end {section} -->")
        if not (begin and end):
            raise PluginError(f"{page}: {name} has no section {section}")
    folder, here = posixpath.dirname(name), posixpath.dirname(page)

    def moved(link: re.Match[str]) -> str:
        target, _, anchor = link[1].partition("#")
        if "://" in target or not target:
            return link[0]
        target = posixpath.normpath(posixpath.join(folder, target))
        target = PAGES.get(target, target)
        if not target.startswith("docs/"):
            return link[0]
        target = posixpath.relpath(target.removeprefix("docs/"), here or ".")
        return f"]({target}{'#' + anchor if anchor else ''})"

    return _LINK.sub(moved, text)


def notebook(path: Path) -> str:
    """Return the cells of a notebook and what they gave as Markdown."""
    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        lines: list[str] = []
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            html = " ".join("".join(data.get("text/html", "")).split())
            if html and "<pre" not in html:
                parts.append(f'<div class="notebook-output">{html}</div>')
            else:
                lines.append("".join(output.get("text") or data.get("text/plain", "")).strip("\n"))
        if lines:
            parts.append("```text\n" + _ANSI.sub("", "\n".join(lines)) + "\n```")
    return "\n\n".join(parts)


def recipe_table(room: str) -> str:
    """Return a table of the methods that a room lists: the parts of each, and what it is given."""
    methods = importlib.import_module(f"spike4dgs.{room}").METHODS
    rows = ["| name | images | initialization | motion | supervision | given |", "|---|---|---|---|---|---|"]
    for name, method in methods.items():
        recipe = getattr(method, "recipe", None)
        parts = [getattr(recipe, part, "") for part in ("images", "initialization", "motion", "supervision")]
        given = ", ".join(getattr(method, "given", ()))
        rows.append(f"| `{name}` | " + " | ".join(f"`{part}`" if part else "" for part in parts) + f" | {given} |")
    return "\n".join(rows)


def name_table(room: str) -> str:
    """Return a table of the names that a room exports: each with a link and the first paragraph of its docstring."""
    rows = ["| name | |", "|---|---|"]
    for module, names in _exports(room):
        for name in names:
            rows.append(f"| [`{name}`][spike4dgs.{room}.{name}] | {_summary(f'spike4dgs.{room}.{module}', name)} |")
    return "\n".join(rows)


def _summary(module: str, name: str) -> str:
    """Return the first paragraph of a name's docstring, where it is defined; of its module's for a table of data."""
    path = ROOT.joinpath(*module.split(".")[1:])
    tree = ast.parse((path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text(encoding="utf-8"))
    text = ast.get_docstring(tree)
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module and name in [alias.name for alias in node.names]:
            return _summary(node.module, name)
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            text = ast.get_docstring(node)
    return (text or "").partition("\n\n")[0].replace("\n", " ").replace("|", "\\|")


def _exports(room: str) -> list[tuple[str, tuple[str, ...]]]:
    """Return (module, names) as the room's `__init__` passes them to `lazy_names`."""
    for node in ast.walk(ast.parse((ROOT / room / "__init__.py").read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "lazy_names":
            return list(ast.literal_eval(node.args[1]).items())
    return []


def api(room: str, module: str, names: tuple[str, ...]) -> str:
    """Return the import line and mkdocstrings' blocks of a module's names; without names, of those the room exports."""
    package = f"spike4dgs.{room}"
    if names:
        package = f"{package}.{module}"
    else:
        names = dict(_exports(room)).get(module, ())
        if not names:
            raise PluginError(f"{package} exports nothing of {module}: name what the page shows")
    names = tuple(sorted(names, key=lambda name: name[0].isupper()))  # functions, then classes and tables
    blocks = [f"```python\nfrom {package} import {', '.join(names)}\n```\n"]
    return "\n".join([*blocks, *(f"::: {package}.{name}\n" for name in names)])
