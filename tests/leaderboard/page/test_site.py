"""The files of the page: complete, small, the same each time, and of pinned libraries."""

from __future__ import annotations

import csv
import json
import os
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from changes import files_in
from page_boards import board, cell, failed, row

from spike4dgs.benchmark import files
from spike4dgs.benchmark.errors import UserError
from spike4dgs.leaderboard.page import site
from spike4dgs.leaderboard.page.site import script, write_site


def small() -> list[site.Board]:
    return [board("b", [row(n, {"s": cell({"psnr": np.arange(3) + i})}) for i, n in enumerate(("one", "two"))])]


def test_a_page_is_replaced_and_equal_boards_give_equal_bytes(tmp_path: Path) -> None:
    out = tmp_path / "page"
    write_site(out, [*small(), *small()])
    write_site(out, small())
    write_site(tmp_path / "again", small())
    assert files_in(out) == files_in(tmp_path / "again")


@pytest.mark.parametrize("after", [0, 1, 2, 7, 20])
def test_a_page_that_was_killed_while_it_was_written_is_replaced(
    tmp_path: Path, after: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process ends as the given number of files have their names, and leaves another one half written."""
    count = 0

    def replace(part: str, path: Path) -> None:
        nonlocal count
        if (count := count + 1) > after:
            raise KeyboardInterrupt
        os.rename(part, path)

    out = tmp_path / "page"
    with monkeypatch.context() as killed:
        other = {"replace": replace, "getpid": lambda: 1}  # the next process has another number
        killed.setattr(files, "os", SimpleNamespace(**{**vars(os), **other}))
        killed.setattr(Path, "unlink", lambda *_, **__: None)
        with pytest.raises(KeyboardInterrupt):
            write_site(out, small())
    assert [p for p in out.rglob("*") if ".part" in p.name]
    write_site(out, small())
    write_site(tmp_path / "again", small())
    assert files_in(out) == files_in(tmp_path / "again")


def test_two_pages_at_once_do_not_remove_each_others_files(tmp_path: Path) -> None:
    write_site(tmp_path, small())
    with files.locked(tmp_path / ".lock", tmp_path, "free"), pytest.raises(UserError, match="no other page is written"):
        write_site(tmp_path, small())


def test_a_folder_with_anything_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "data/car").mkdir(parents=True)
    (tmp_path / "data/car/scene.json").touch()
    with pytest.raises(UserError, match="an earlier page"):
        write_site(tmp_path, small())
    assert [p.name for p in tmp_path.rglob("*")] == ["data", "car", "scene.json"]


def test_a_linked_folder_is_somebody_elses(tmp_path: Path) -> None:
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious/notes.txt").write_text("mine")
    (tmp_path / "out").mkdir()
    (tmp_path / "out/data").symlink_to(tmp_path / "precious")
    with pytest.raises(UserError, match="a new or empty folder, or an earlier page, found something else"):
        write_site(tmp_path / "out", [])
    assert [path.name for path in (tmp_path / "precious").iterdir()] == ["notes.txt"]


def test_no_cell_is_a_formula_of_a_spreadsheet(tmp_path: Path) -> None:
    device, error = "=HYPERLINK(1)", "-2+3"
    cells = {"s": cell({"psnr": np.full(2, -1.5)}, device=device), "t": failed(error)}
    write_site(tmp_path / "page", [board("b", [row("one", cells)])])
    ok, lost = csv.DictReader((tmp_path / "page/data/cells-0.csv").read_text().splitlines())
    assert (ok["device"], lost["error"], ok["psnr"]) == (f"'{device}", f"'{error}", "-1.5")


def test_data_are_strings_of_a_script() -> None:
    value = {"__proto__": "</script><script>alert(1)</script>\u2028", "a": [1.5, None]}
    text = script("boards", value)
    found = re.fullmatch(r"Spike4DGS\.receive\((\".*?\"), (\".*\")\);\n", text)
    assert found and json.loads(found[1]) == "boards" and json.loads(json.loads(found[2])) == value
    assert "\u2028" not in text


def test_a_changed_library_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    vendor = tmp_path / "vendor"
    vendor.mkdir()
    for path in (site.STATIC / "vendor").iterdir():
        (vendor / path.name).write_bytes(path.read_bytes() + (b" " if path.name == "d3.min.js" else b""))
    monkeypatch.setattr(site, "STATIC", tmp_path)
    with pytest.raises(UserError, match="d3.min.js: expected sha256 912111098ea99503"):
        write_site(tmp_path / "page", small())
    listed = {line.partition("  ")[2] for line in (vendor / "SHA256SUMS").read_text().splitlines()}
    assert listed == {p.name for p in vendor.iterdir()} - {"SHA256SUMS"}


def test_the_notice_names_each_licence_and_where_files_are_installed(pytestconfig: pytest.Config) -> None:
    root = pytestconfig.rootpath
    notice = (root / "NOTICE").read_text()
    parts = {path.name.partition(".")[2] for path in (site.STATIC / "vendor").glob("LICENSE.*")}
    assert {"interval-tree-1d", "binary-search-bounds", "isoformat", "delaunator"} <= parts
    assert not [part for part in parts if not re.search(rf"\b{part}\b", notice)]
    installed = re.findall(r"file (\S+) \(installed as spike4dgs/(\S+)\)", notice)
    assert len(installed) == 2 and all(path == there and (root / path).is_file() for path, there in installed)
