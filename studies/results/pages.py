"""The pages with generated blocks: what stands between `<!-- records: NAME -->` and `<!-- end records -->`."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import write_text
from spike4dgs.studies.kit.blocks import pattern
from spike4dgs.studies.results.blocks import NINE, headline_block, home_block, lead_block, scenes_block, table_block
from spike4dgs.studies.results.plan import TABLE1, TABLE2, TABLE3, TABLE4, TABLE7
from spike4dgs.studies.results.records import Record
from spike4dgs.studies.results.tables.breaks import breaks_block
from spike4dgs.studies.results.tables.conditions import conditions_block, content_block
from spike4dgs.studies.results.tables.covisible import covisible_block
from spike4dgs.studies.results.tables.images import images_block
from spike4dgs.studies.results.tables.modality import modality_block, noisy_block
from spike4dgs.studies.results.tables.paper import paper_block
from spike4dgs.studies.results.tables.parts import own_scenes_block, parts_block, self_calibrated_block
from spike4dgs.studies.results.tables.published import pairs_block, published_block, unposed_block, views_block
from spike4dgs.studies.results.tables.realistic import cameras_block, realistic_block
from spike4dgs.studies.results.tables.steps import steps_block

BLOCKS: dict[str, Callable[[Sequence[Record]], list[str]]] = {  # by their names in markers
    "conditions": conditions_block,
    "breaks": breaks_block,
    "cameras": cameras_block,
    "content": content_block,
    "covisible": covisible_block,
    "headline": lambda records: headline_block(NINE, records),
    "home": home_block,
    "lead": lambda records: lead_block(NINE, records),
    "modality": modality_block,
    "modality-noisy": noisy_block,
    "nine-scenes": lambda records: table_block(NINE, records),
    "own-scenes": own_scenes_block,
    "pairs": pairs_block,
    "paper": paper_block,
    "parts": parts_block,
    "published": lambda records: published_block(TABLE1, 1, records),
    "realistic": realistic_block,
    "self-calibrated": self_calibrated_block,
    "steps": steps_block,
    "table1": lambda records: table_block(TABLE1, records),
    "table1-scenes": lambda records: scenes_block(TABLE1, records),
    "table2": lambda records: table_block(TABLE2, records),
    "table2-scenes": lambda records: scenes_block(TABLE2, records),
    "table3": lambda records: published_block(TABLE3, 3, records),
    "table4": lambda records: published_block(TABLE4, 4, records),
    "table5": views_block,
    "table6": images_block,
    "table7": lambda records: published_block(TABLE7, 7, records),
    "unposed": unposed_block,
}

BLOCK = pattern("records")
_MARKER = re.compile(r"^<!-- (?:records: .*|end records) -->$", re.MULTILINE)


def pages_of(root: Path) -> list[Path]:
    """Return the pages of a checkout that figures of quality stand on."""
    docs = root / "docs"
    return [root / "README.md", docs / "index.md", *sorted((docs / "results").glob("*.md"))]


def with_blocks(text: str, records: Sequence[Record], where: Path | str) -> str:
    """Return the text of a page with every block made of the records.

    Raises UserError for a block that is not known, and for a marker without its partner.
    """

    def made(found: re.Match[str]) -> str:
        name = found["name"]
        if name not in BLOCKS:
            raise problem(where, f"a block among {', '.join(BLOCKS)}", repr(name), "correct the marker")
        return "\n".join([f"<!-- records: {name} -->", *BLOCKS[name](records), "<!-- end records -->"])

    replaced = BLOCK.sub(made, text)
    if len(_MARKER.findall(text)) != 2 * len(BLOCK.findall(text)):
        raise problem(where, "a marker `end records` below each marker `records`", "another number", "correct the page")
    return replaced


def outdated(root: Path, records: Sequence[Record]) -> list[Path]:
    """Return the pages whose blocks are not what the records give."""
    return [
        page for page in pages_of(root) if with_blocks(text := page.read_text("utf-8"), records, page) != text
    ]  # fmt: skip


def write_pages(root: Path, records: Sequence[Record]) -> list[Path]:
    """Write the blocks of all pages anew, and return the pages that changed."""
    changed = outdated(root, records)
    for page in changed:
        write_text(page, with_blocks(page.read_text("utf-8"), records, page))
    return changed
