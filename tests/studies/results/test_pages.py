"""The pages say what the records say, and have no more figures outside of generated blocks than they had."""

from pathlib import Path

import pytest
from made_records import record

from spike4dgs.benchmark.errors import UserError
from spike4dgs.studies.results import code_state
from spike4dgs.studies.results.blocks import NOTHING
from spike4dgs.studies.results.command import Choice, results
from spike4dgs.studies.results.loose_figures import counts, loose_figures, read_ratchet, risen
from spike4dgs.studies.results.pages import outdated, with_blocks, write_pages
from spike4dgs.studies.results.plan import TABLE1
from spike4dgs.studies.results.records import read_records, write_row

ROOT = Path(__file__).resolve().parents[3]
PAGE = "Words.\n\n<!-- records: table1 -->\nanything\n<!-- end records -->\n\nIt is 3 dB better.\n"


def test_every_block_of_the_checkout_is_what_the_records_give() -> None:
    records = list(read_records(ROOT / "studies" / "results" / "records").values())
    assert outdated(ROOT, records) == [], "run `spike4dgs report results --write`"


def test_no_page_has_more_loose_figures_than_it_had() -> None:
    assert risen(counts(ROOT), read_ratchet(ROOT)) == [], "make the figures from records, or take them out of the text"


def test_blocks_are_replaced_and_nothing_else() -> None:
    made = with_blocks(PAGE, [], "page.md")
    assert made == PAGE.replace("anything", NOTHING) and with_blocks(made, [], "page.md") == made
    full = with_blocks(PAGE, [record(scene=scene) for scene in TABLE1.scenes], "page.md")
    assert "| 1 | `spike4dgs-x+self-calibrated` | 32.06 |" in full and full.endswith("\n\nIt is 3 dB better.\n")
    assert with_blocks(full, [], "page.md") == made


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PAGE.replace("table1", "table9"), "page.md: expected a block among conditions, .*, found 'table9'"),
        (PAGE.replace("<!-- end records -->\n", ""), "a marker `end records` below each"),
        (PAGE + "<!-- end records -->\n", "a marker `end records` below each"),
        (PAGE.replace("table1", "Table 1"), "a marker `end records` below each"),
    ],
)
def test_broken_markers_are_refused(text: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        with_blocks(text, [], "page.md")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("It leads by 7.8 and\n7.1 dB, or 10-12 dB.", [(1, "7.8"), (2, "7.1"), (2, "10"), (2, "12")]),
        ("| a | 0.97 | 12 |\n| 34.1 | 3.125 |", [(1, "0.97"), (2, "3.125")]),
        ("| a | 4.95 dB |", [(1, "4.95")]),
        ("In 30.25 s, version 1.25.3, and 3 dBm.", []),
        ("| version 1.25.3 |", []),
        ("```\n7 dB\n```\nthen 8 dB", [(4, "8")]),
        (PAGE.replace("anything", "| 30.25 |\n5 dB"), [(8, "3")]),
    ],
)
def test_loose_figures_are_decibels_and_two_decimals_in_tables(text: str, expected: list[tuple[int, str]]) -> None:
    assert list(loose_figures(text)) == expected


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout with one page and a ratchet."""
    (tmp_path / "docs" / "results").mkdir(parents=True)
    (tmp_path / "docs/results/page.md").write_text(PAGE)
    for page in ("README.md", "docs/index.md"):
        (tmp_path / page).write_text("Nothing.\n")
    (tmp_path / "studies" / "results").mkdir(parents=True)
    (tmp_path / "studies/results/loose_figures.json").write_text('{"docs/results/page.md": 2, "README.md": 1}')
    monkeypatch.setattr(code_state, "ROOT", tmp_path)
    return tmp_path


def test_the_command_checks_and_writes_and_its_ratchet_only_falls(checkout: Path, capsys) -> None:
    page, records = checkout / "docs/results/page.md", checkout / "records"
    write_row(records, "spike4dgs-x+self-calibrated", [record(scene=scene) for scene in TABLE1.scenes])
    assert results(check=True, records=records) == 1
    shown = capsys.readouterr()
    assert "docs/results/page.md:7: 3\n" in shown.out and "page.md: 1 figures outside generated blocks, 2" in shown.out
    assert "docs/results/page.md: its blocks are not what the records give" in shown.err
    assert results(write=True, records=records) == 0 and "`spike4dgs-x+self-calibrated`" in page.read_text()
    assert read_ratchet(checkout) == {"docs/results/page.md": 1}
    assert results(check=True, records=records) == 0
    page.write_text(page.read_text() + "And 4 dB.\n")
    assert results(check=True, write=True, records=records) == 1
    assert "more figures outside generated blocks: docs/results/page.md: 2, 1 allowed" in capsys.readouterr().err
    assert read_ratchet(checkout) == {"docs/results/page.md": 1}


def test_options_of_a_sweep_are_refused_beside_pages(checkout: Path) -> None:
    with pytest.raises(UserError, match="neither --write nor --check beside options of a sweep"):
        results(write=True, choice=Choice(only=("table1",)), records=checkout / "records")


def test_pages_are_written_where_they_change_alone(checkout: Path) -> None:
    assert write_pages(checkout, []) == [checkout / "docs/results/page.md"]
    assert write_pages(checkout, []) == []
