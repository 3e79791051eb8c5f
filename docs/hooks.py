"""MkDocs hooks of the docs site: find the package's sources, include files, list modules."""

from __future__ import annotations

import os
import posixpath
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("benchmark", "generators", "method", "baselines", "leaderboard")
SOURCES = ROOT / "build" / "docs" / "spike4dgs"  # links to the rooms, under the name that they are imported by
PAGES = {  # files outside docs/ that have a page on the site
    "CONTRIBUTING.md": "docs/contributing.md",
    "examples/README.md": "docs/external_methods.md",
    "method/msdi/README.md": "docs/methods/msdi_card.md",
    "baselines/spike_to_image/spk2img/README.md": "docs/methods/spk2img_card.md",
}
_TEXT_ONLY = "    options: {members: false, show_root_heading: false, show_root_toc_entry: false}\n"
_INCLUDE = re.compile(r"^<!-- include (\S+)(?: (\w+))? -->$", re.MULTILINE)
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_MODULES = re.compile(r"^<!-- modules of (\w+) -->$", re.MULTILINE)


def on_config(config: Any, **kwargs: Any) -> Any:
    """Link each room into one folder `spike4dgs`, where mkdocstrings looks for it.

    The rooms are top-level folders; only an installation knows that they form one package.
    """
    SOURCES.mkdir(parents=True, exist_ok=True)
    for room in ROOMS:
        link = SOURCES / room
        if not link.is_symlink() or link.resolve() != ROOT / room:
            link.unlink(missing_ok=True)
            link.symlink_to(ROOT / room, target_is_directory=True)
    # The folder of scripts is on the path, and its program `spike4dgs` would be taken for the package.
    sys.path[:] = [path for path in sys.path if not (Path(path) / "spike4dgs").is_file()]
    return config


def on_page_markdown(markdown: str, page: Any, **kwargs: Any) -> str:
    """Expand `<!-- modules of ROOM -->` and `<!-- include FILE [SECTION] -->`."""
    markdown = _INCLUDE.sub(lambda found: included(found[1], found[2], page.file.src_uri), markdown)
    return _MODULES.sub(lambda found: module_list(found[1]), markdown)


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


def module_list(room: str) -> str:
    """Return the mkdocstrings blocks of all public modules of a room, folder by folder."""
    blocks = []
    for folder, folders, files in os.walk(ROOT / room):
        folders[:] = sorted(name for name in folders if name != "__pycache__" and _has_source(Path(folder) / name))
        package = ".".join(["spike4dgs", *Path(folder).relative_to(ROOT).parts])
        if package.count(".") > 1:
            blocks.append(f"## `{package}`\n\n::: {package}\n{_TEXT_ONLY}")
        for name in sorted(files):
            module = name.removesuffix(".py")
            if name.endswith(".py") and not module.startswith("__"):
                blocks.append(f"::: {package}.{module}\n")
    return "\n".join(blocks)


def _has_source(folder: Path) -> bool:
    return any(folder.glob("*.py"))
