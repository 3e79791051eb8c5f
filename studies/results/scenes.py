"""The scenes of a sweep: known by their revisions and, where another processor made them, by their fingerprints.

RECORDS/scenes/SCENE.npz is the fingerprint of the scene that the first record of it was measured on. Of a scene of the
current release it is with the release.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from rich.console import Console

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.release.fingerprint import compare, make_fingerprint, read_fingerprint, write_fingerprint
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.leaderboard.tracks import fingerprint_path
from spike4dgs.studies.results.records import DIGITS, Record


def revisions_of(scenes: Iterable[Scene], records: Iterable[Record], folder: Path, console: Console) -> dict[str, str]:
    """Return the revision of each scene for its records: its own, or that of the records that it equals.

    Fingerprints that `folder`, of the records, lacks are written. Raises UserError for a scene that differs from that
    of its records by more than rounding.
    """
    known = {record["scene"]: record["revision"] for record in records}
    found: dict[str, str] = {}
    for scene in scenes:
        own = scene.revision[:DIGITS]
        found[scene.id] = known.get(scene.id, own)
        path = fingerprint_path(scene.id, found[scene.id])
        if not path.is_file():
            path = folder / "scenes" / f"{scene.id}.npz"
            if found[scene.id] == own and not (scene.id in known and path.is_file()):
                write_fingerprint(path, make_fingerprint(scene))
        if found[scene.id] != own:
            _check_equivalent(scene, found[scene.id], path, console)
    return found


def _check_equivalent(scene: Scene, revision: str, path: Path, console: Console) -> None:
    reason = "no fingerprint of the records' scene to compare with"
    if path.is_file():
        match = compare(scene, read_fingerprint(path))
        reason = match.reasons[0] if match.reasons else f"a fingerprint of revision {match.revision[:DIGITS]}"
        if match.is_equivalent and match.revision.startswith(revision):
            share = f"{match.bits:.4%} of its spike bits differ"
            console.print(f"{scene.id}: made with other rounding than the records' {revision}; {share}")
            return
    fix = "use that scene, or move the records elsewhere and measure every row anew"
    found = f"{scene.revision[:DIGITS]} ({reason})"
    raise problem(scene.root, f"revision {revision}, as in the records", found, fix)
