"""The leaderboard: submissions, verification, ranks, and the committed entries."""

from typing import TYPE_CHECKING

from spike4dgs.benchmark.lazy import lazy_names

if TYPE_CHECKING:
    from spike4dgs.leaderboard.entry import read_entry
    from spike4dgs.leaderboard.rank import rank_entries, write_leaderboard
    from spike4dgs.leaderboard.submit_command import submit
    from spike4dgs.leaderboard.verify import verify_record
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "entry": ("read_entry",),
            "rank": ("rank_entries", "write_leaderboard"),
            "submit_command": ("submit",),
            "verify": ("verify_record",),
        },
    )

__all__ = ["rank_entries", "read_entry", "submit", "verify_record", "write_leaderboard"]
