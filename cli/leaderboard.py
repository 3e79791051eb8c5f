"""`leaderboard`: print the ranking; `leaderboard build`: write the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.cells import cell_len
from rich.console import Group
from rich.table import Table
from rich.text import Text

from spike4dgs.benchmark.errors import unknown
from spike4dgs.benchmark.metrics.measure import mean
from spike4dgs.benchmark.metrics.table import METRICS, PRIMARY
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.benchmark.runs.record import COSTS
from spike4dgs.leaderboard.entry import reading_folder
from spike4dgs.leaderboard.page.intervals import LEVEL
from spike4dgs.leaderboard.page.rows import Board, find_board, gather, titles
from spike4dgs.leaderboard.page.scores import compare_rows, image_scores
from spike4dgs.leaderboard.page.site import write_site
from spike4dgs.leaderboard.tracks import RELEASE, SHIPPED


def show(
    *,
    track: str | None = None,
    metric: str = PRIMARY,
    runs: tuple[Path, ...] = (),
    leaderboard: Path | None = None,
) -> int:
    """Print the ranking of each track, with rank intervals and ties.

    The ranking includes the published entries, which come with the package. Methods whose rank intervals start with the
    same number cannot be told apart from the best of them. `leaderboard build` writes the same as a page, with filters,
    plots and images.

    Args:
        track: Only this track.
        metric: Metric to rank by, such as psnr_dynamic.
        runs: Folders of run-benchmark, to show your own methods among the entries.
        leaderboard: Leaderboard folder; ./leaderboard if left out, where it has entries.
    """
    if metric not in METRICS:
        raise unknown("--metric", metric, METRICS, "docs/metrics.md")
    folder, console = reading_folder(leaderboard), make_console()
    boards, refused = gather(folder, runs, published=True, brief=metric == PRIMARY and not runs)
    if folder == SHIPPED:
        text = f"published entries of release {RELEASE}, as this version ships them"
        console.print(text if runs else f"{text}; --runs OUT adds your own", markup=False)
    for board in [find_board(boards, track)] if track else boards:
        if track or any(row.ranked for row in board.rows):
            console.print(ranking_table(board, metric, console.width))
    for run in runs if track else ():
        on = _boards_of(boards, run)
        if on and not any(track in names for names in on):
            text = f"no record of exactly the scenes of {track}, given what it gives"
            boards_text = ", ".join(title for _, title in on)
            console.print(f"{run}: {text}; it is on the board {boards_text}", highlight=False, markup=False)
    for item in refused:
        console.print(f"not listed: {item['entry']}: {item['reason']}", markup=False)
    return 0


def _boards_of(boards: Sequence[Board], run: Path) -> list[tuple[str, str]]:
    """Return name and title of the boards that list a run, or entries to whose rows it lends its images."""
    return [
        (board.name, title)
        for board, title in zip(boards, titles(boards), strict=True)
        if any(row.run == run or any(run in path.parents for path in row.predictions.values()) for row in board.rows)
    ]


def build(
    *,
    out: Path = Path("runs/leaderboard"),
    runs: tuple[Path, ...] = (),
    data: Path = Path("data"),
    leaderboard: Path | None = None,
) -> int:
    """Write the leaderboard as a page of files, which a browser opens from the disk.

    The page shows every board of the leaderboard and the published entries, with an image of each scene if an entry has
    a sheet. With --runs it also shows your own finished runs, with all their images if --data has the scenes. If a run
    equals an entry, its images appear in the entry's row. An earlier page in the folder is replaced.

    Args:
        out: Folder of the page.
        runs: Folders of run-benchmark.
        data: Folder of the scenes.
        leaderboard: Leaderboard folder; ./leaderboard if left out, where it has entries.
    """
    console = make_console()

    def say(text: str) -> None:
        console.print(text, markup=False)

    boards, refused = gather(reading_folder(leaderboard), runs, published=True)
    site = write_site(out, boards, refused, data, say)
    for line in site.left_out:
        say(f"left out: {line}")
    for item in refused:
        say(f"not listed: {item['entry']}: {item['reason']}")
    say(f"{site.files} files, first view {site.first_view_bytes / 1e6:.2f} MB; open {out / 'index.html'}")
    return 0


def ranking_table(board: Board, metric: str, width: int) -> Table:
    """Return a board's ranking as a table for `width` characters; rows without a rank come last, with the reason."""
    scores = image_scores(board, metric)
    comparison = compare_rows(scores, metric)
    m = METRICS[metric]
    table = Table(
        title=f"{board.name}: {board.title}", box=None, title_justify="left", padding=(0, 0, 0, 1), pad_edge=False
    )
    table.caption = f"rank: simultaneous {LEVEL:.0%} intervals; methods that cannot be told apart tie"
    if len({row.hardware for row in board.rows if _costs(row.records)[:2] != ["-", "-"]}) > 1:
        table.caption += "\nFit times and images/s are of different machines: do not compare them."
    for title in (
        "rank",
        "method",
        f"{m.title}{f', {m.unit}' if m.unit else ''}",
        "ties with",
        *(t for t, _ in COSTS.values()),
    ):
        left = title in ("method", "ties with")
        # Names are never cut; units break into a second line.
        table.add_column(
            title.replace(", ", "\n"), justify="left" if left else "right", no_wrap=title == "method", overflow="fold"
        )
    numbers, rows = list(scores.values), list[tuple[str, ...]]()
    if comparison is not None:
        for k in np.argsort(-comparison.means if m.higher_is_better else comparison.means, kind="stable"):
            best, worst = comparison.best_ranks[k], comparison.worst_ranks[k]
            tied = comparison.tied(int(k))
            rank = str(best) if best == worst else f"{best}-{worst}"
            names = [board.rows[numbers[j]].name for j in tied[:3]]
            shown = ", ".join(names) if len(tied) <= 3 else f"{len(tied)} methods"
            name = board.rows[numbers[k]].name
            cells = (rank, name, m.format(comparison.means[k]), shown, *_costs(board.rows[numbers[k]].records))
            rows.append(cells)
    rows += [("-", board.rows[i].name, "", why, *_costs(board.rows[i].records)) for i, why in scores.left_out.items()]
    return _with_rows(table, rows, width)


def _with_rows(table: Table, rows: Sequence[tuple[str, ...]], width: int) -> Table:
    """Return a table for `width` characters with rows: their lines are laid out here if no cell breaks.

    A thousand rows then take a tenth of rich's time.
    """
    heads = [max(map(cell_len, str(column.header).split("\n"))) for column in table.columns]
    widths = [max(head, *map(cell_len, cells)) for head, cells in zip(heads, zip(*rows, strict=True), strict=False)]
    if not rows or sum(widths) + len(widths) > width:
        for row in rows:
            table.add_row(*map(Text, row))
        return table
    whole = Table(
        title=table.title, caption=table.caption, box=None, title_justify="left", padding=0, show_header=False
    )
    for column, size in zip(table.columns, widths, strict=True):
        column.width = size
    table.title = table.caption = None
    left = [column.justify == "left" for column in table.columns]
    lines = (
        " ".join(
            f"{cell}{blanks}" if on_left else f"{blanks}{cell}"
            for cell, size, on_left in zip(row, widths, left, strict=True)
            for blanks in [" " * (size - cell_len(cell))]
        )
        for row in rows
    )
    whole.add_row(Group(table, Text("\n".join(lines), no_wrap=True, overflow="ignore")))
    return whole


def _costs(records: tuple[Mapping[str, Any], ...]) -> list[str]:
    """Return the means over scenes and seeds; a dash where one is missing."""
    cells = [cell for r in records for cell in r["scenes"].values()]
    means = [(mean(cell[cost] for cell in cells), digits) for cost, (_, digits) in COSTS.items()]
    return ["-" if value is None else f"{value:.{digits}f}" for value, digits in means]
