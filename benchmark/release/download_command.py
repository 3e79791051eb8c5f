"""`download`: fetch scenes of a release, all of a track's or some, whole or in part."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.release.progress import size_text
from spike4dgs.benchmark.release.scenes import WORKERS, download, open_release
from spike4dgs.benchmark.release.selection import Selection
from spike4dgs.benchmark.release.source import find_source
from spike4dgs.benchmark.release.track import check_revisions

ALL = "all"
From = Annotated[str | None, arg(name="from")]


def make_download(track_scenes: Callable[[str], dict[str, str]]) -> Callable[..., int]:
    """Return the command `download`; `track_scenes` gives the revisions of a track's scenes by their ids."""

    def command(
        track: Positional[str],
        *,
        source: From = None,
        out: Path = Path("data"),
        scenes: tuple[str, ...] = (),
        cameras: tuple[str, ...] = (),
        parts: tuple[str, ...] = (),
        window_ms: tuple[float, float] | None = None,
        sha256: str | None = None,
        workers: int = WORKERS,
    ) -> int:
        """Fetch scenes of a release; every byte is verified as it arrives. A killed download goes on where it was.

        Without --scenes, --cameras, --parts or --window-ms, whole scenes are fetched. `download weights` fetches
        weight files.

        Args:
            track: A track such as outdoor-small, whose revisions the release must have; or all scenes of the release.
            source: Where the release lies: https://..., hf://datasets/OWNER/NAME, s3://..., file://... or a path;
                SPIKE4DGS_RELEASE if left out.
            out: Folder for the scenes.
            scenes: Only these.
            cameras: Only files of these cameras, beside the scene's own.
            parts: Only these parts, such as spikes, calibration or images, beside the scene's description.
            window_ms: Only the streams, from the first to the second millisecond, as OUT/SCENE-START-STOPms: a folder
                of streams to look at, which is no scene of the track.
            sha256: The SHA-256 of release.json, which pins every byte of the release.
            workers: Requests at the same time.
        """
        if workers < 1:
            raise problem("--workers", "at least 1", str(workers), "correct the number")
        found = find_source(source, "a release")
        revisions = None if track == ALL else track_scenes(track)
        release = open_release(found, sha256)
        if revisions is not None:
            if unknown := [s for s in scenes if s not in revisions]:
                raise problem("--scenes", f"scenes of {track}: {', '.join(revisions)}", unknown[0], "correct the name")
            revisions = {s: r for s, r in revisions.items() if not scenes or s in scenes}
            check_revisions(found, release, revisions)
        chosen = Selection(scenes if revisions is None else tuple(revisions), cameras, parts, window_ms)
        chosen.check(release)
        wanted = chosen.entries(release)
        size = size_text(sum(map(chosen.bytes_of, wanted)))
        print(f"release {release.name} (sha256 {release.sha256}): {len(wanted)} scenes, {size} asked for")
        report = download(found, release, chosen, out, workers)
        for folder in report.folders:
            print(folder)
        print(report.line)
        return 0

    return command
