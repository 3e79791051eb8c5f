"""The leaderboard: tracks, submissions, verification, ranks, and the committed entries."""

from typing import TYPE_CHECKING

from spike4dgs.benchmark.lazy import lazy_names

if TYPE_CHECKING:
    from spike4dgs.leaderboard.rank import rank_entries, write_boards
    from spike4dgs.leaderboard.reading import read_entries
    from spike4dgs.leaderboard.submit import submit_all
    from spike4dgs.leaderboard.tracks import current_release, place_of
    from spike4dgs.leaderboard.verify import verify_record
    from spike4dgs.leaderboard.verify_entries import verify_leaderboard
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "rank": ("rank_entries", "write_boards"),
            "reading": ("read_entries",),
            "submit": ("submit_all",),
            "tracks": ("current_release", "place_of"),
            "verify": ("verify_record",),
            "verify_entries": ("verify_leaderboard",),
        },
    )

__all__ = [
    "current_release",
    "place_of",
    "rank_entries",
    "read_entries",
    "submit_all",
    "verify_leaderboard",
    "verify_record",
    "write_boards",
]
