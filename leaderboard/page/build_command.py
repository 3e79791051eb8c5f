"""`leaderboard build`: write the page."""

from __future__ import annotations

from pathlib import Path

from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.leaderboard.page.rows import gather
from spike4dgs.leaderboard.page.site import write_site


def build(
    *,
    out: Path = Path("runs/leaderboard"),
    runs: tuple[Path, ...] = (),
    data: Path = Path("data"),
    leaderboard: Path = Path("leaderboard"),
) -> int:
    """Write the leaderboard as a page of files, which a browser opens from the disk.

    The page has every board of the leaderboard. With --runs it has the reader's own finished runs beside the entries,
    and their images where --data has the scenes: a run that equals an entry lends its images to the entry. An earlier
    page in the folder is replaced.

    Args:
        out: Folder of the page.
        runs: Folders of run-benchmark.
        data: Folder of the scenes.
        leaderboard: Leaderboard folder.
    """
    console = make_console()

    def say(text: str) -> None:
        console.print(text, markup=False)

    boards, refused = gather(leaderboard, runs)
    site = write_site(out, boards, refused, data, say)
    for line in site.left_out:
        say(f"left out: {line}")
    for item in refused:
        say(f"not listed: {item['entry']}: {item['reason']}")
    say(f"{site.files} files, first view {site.first_view_bytes / 1e6:.2f} MB; open {out / 'index.html'}")
    return 0
