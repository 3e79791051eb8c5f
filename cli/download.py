"""`download`: fetch scenes of a release, all of a track's or some, whole or in part."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tyro.conf import OmitArgPrefixes, Positional

from spike4dgs.benchmark.errors import problem, unknown
from spike4dgs.benchmark.release.scenes import WORKERS, check_revisions, open_release
from spike4dgs.benchmark.release.scenes import download as fetch_scenes
from spike4dgs.benchmark.release.selection import EVERYTHING, Selection
from spike4dgs.benchmark.release.source import find_source, size_text
from spike4dgs.cli.options import From
from spike4dgs.leaderboard.tracks import track_scenes

ALL = "all"


def download(
    track: Positional[str],
    *,
    source: From = None,
    out: Path = Path("data"),
    selection: OmitArgPrefixes[Selection] = EVERYTHING,
    sha256: str | None = None,
    workers: int = WORKERS,
) -> int:
    """Fetch scenes of a release; every byte is verified as it arrives. A killed download resumes where it stopped.

    Without --scenes, --cameras, --parts or --window-ms, whole scenes are fetched. `download weights` fetches
    weight files.

    Args:
        track: A track such as ideal, whose revisions the release must have, or `all` for all scenes of the release.
        source: Where the release is: https://..., hf://datasets/OWNER/NAME, s3://..., file://... or a path;
            SPIKE4DGS_RELEASE if left out.
        out: Folder for the scenes.
        sha256: The SHA-256 of release.json, which pins every byte of the release.
        workers: Number of simultaneous requests.
    """
    if workers < 1:
        raise problem("--workers", "at least 1", str(workers), "correct the number")
    found = find_source(source, "a release")
    revisions = None if track == ALL else track_scenes(track)
    release = open_release(found, sha256)
    if revisions is not None:
        if others := [s for s in selection.scenes if s not in revisions]:
            raise unknown(f"--scenes of {track}", others[0], revisions)
        revisions = {s: r for s, r in revisions.items() if not selection.scenes or s in selection.scenes}
        check_revisions(found, release, revisions)
    chosen = selection if revisions is None else replace(selection, scenes=tuple(revisions))
    chosen.check(release)
    wanted = chosen.entries(release)
    size = size_text(sum(map(chosen.bytes_of, wanted)))
    print(f"release {release.name} (sha256 {release.sha256}): {len(wanted)} scenes, {size} asked for")
    report = fetch_scenes(found, release, chosen, out, workers)
    for folder in report.folders:
        print(folder)
    print(report.line)
    return 0
