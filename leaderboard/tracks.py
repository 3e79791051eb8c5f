"""The tracks of a release: frozen lists of scenes with their revisions, and the place of a record among them.

    leaderboard/releases/2.json                the tracks
    leaderboard/releases/2/SCENE@REVISION.npz  the fingerprint of a scene
    leaderboard/releases/SHA256SUMS            the files' hashes: a release does not change

Tracks may have scenes of one id and several revisions: the same world, rendered otherwise.

A record of exactly a track's scenes, revisions and split is public. So is one of equivalent scenes, which a processor
that rounds otherwise made: their fingerprints say so, and the record gets the release's revisions and the share of
bits that differ. The folder of a public record is that of the first such track; its method is on the boards of all of
them that withhold nothing it was given. Any other record is local.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.errors import problem, unknown
from spike4dgs.benchmark.files import read_json, sha256_json
from spike4dgs.benchmark.method import DEFAULT_GIVEN, is_changed
from spike4dgs.benchmark.release.fingerprint import Match, compare, read_facts, read_fingerprint
from spike4dgs.benchmark.runs.record import NOISY, Record
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.benchmark.untrusted import is_id

SHIPPED = Path(str(files("spike4dgs.leaderboard")))  # the released entries, as the package holds them
FOLDER = SHIPPED / "releases"
RELEASE = "2"
PUBLIC, LOCAL, ARCHIVE = "entries", "local", "archive"
REVISION_DIGITS = 12  # of revisions in paths and messages
CHANGED = "the method ran with other settings (--set); a track takes it as a recipe with a name of its own"
_NAMED = 3  # scenes that a message names
_FROZEN = "restore the file: a release does not change, what is new goes into the next one"

OTHER_SENSORS = frozenset(("frames", "events"))  # no revision covers these, so every track withholds them


@dataclass(frozen=True)
class Track:
    """A frozen list of scenes with their revisions; those of an announced track have none and take no entries."""

    name: str
    title: str
    announced: bool
    split: str
    withheld: frozenset[str]
    scenes: Mapping[str, str | None]


@dataclass(frozen=True)
class Release:
    """The tracks of a release, and the noise ceilings of its scenes in dB, as far as they were measured."""

    number: str
    tracks: tuple[Track, ...]
    ceilings_db: Mapping[str, float]  # by `scene_name`

    def ceiling_db(self, scene: str, revision: str) -> float | None:
        """Return a scene's noise ceiling; None where it is not known, or where the revision is not the release's."""
        return self.ceilings_db.get(scene_name(scene, revision)) if self._has(scene, revision) else None

    def revisions(self, scene: str) -> tuple[str, ...]:
        """Return the revisions that tracks have of a scene, each once; none of an announced one."""
        known = (track.scenes.get(scene) for track in self.tracks)
        return tuple(dict.fromkeys(revision for revision in known if revision is not None))

    def sensor(self, scene: str, revision: str) -> str | None:
        """Return the sensor of a scene (`runs.record.SENSORS`); None where the revision is not the release's.

        `make-dataset` made all scenes of the releases so far with every term of the noise, which is its default.
        """
        return NOISY if self._has(scene, revision) else None

    def _has(self, scene: str, revision: str) -> bool:
        return revision in self.revisions(scene)


@dataclass(frozen=True)
class Place:
    """Where the entry of a record belongs.

    `folder` is below the leaderboard's folder. `tracks` has the names of the public boards that list the entry; without
    any it is local, and `why` is the reason.
    """

    folder: str
    tracks: tuple[str, ...]
    why: str

    @property
    def is_public(self) -> bool:
        """True for an entry of a track."""
        return bool(self.tracks)


@cache
def read_release(folder: Path, number: str) -> Release:
    """Read a release. Raises UserError where its file is damaged, or is not the one that was frozen."""
    path = folder / f"{number}.json"
    data = read_json(path, f"release {number} of the leaderboard")
    check_schema(data, load_schema("spike4dgs.leaderboard", "release.schema.json"), path, _FROZEN)
    _check_frozen(folder, path)
    tracks = tuple(
        Track(name, t["title"], t["status"] == "announced", t["split"], frozenset(t["withheld"]), t["scenes"])
        for name, t in data["tracks"].items()
    )
    return Release(data["release"], tracks, data["ceilings_db"])


def _check_frozen(folder: Path, path: Path) -> None:
    """Raise UserError unless SHA256SUMS lists the hash of a release's file."""
    sums = folder / "SHA256SUMS"
    listed = sums.read_text(encoding="utf-8").splitlines() if sums.is_file() else []
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if f"{found}  {path.relative_to(folder).as_posix()}" not in listed:
        raise problem(path, f"the bytes whose hash {sums.name} lists", f"sha256 {found[:16]}...", _FROZEN)


def fingerprint_path(scene: str, revision: str) -> Path:
    """Return where the current release has the fingerprint of a scene, if it has one."""
    return FOLDER / RELEASE / f"{scene_name(scene, revision)}.npz"


def released_targets(scene: str, revision: str, split: str) -> frozenset[str] | None:
    """Return the names of the targets of a released scene in a split; None where the release does not say."""
    known = revision in current_release().revisions(scene)
    return _targets(fingerprint_path(scene, revision), split) if known else None


@cache
def _targets(fingerprint: Path, split: str) -> frozenset[str] | None:
    if not fingerprint.is_file():
        return None
    _check_frozen(FOLDER, fingerprint)
    facts = read_facts(fingerprint)
    cameras = facts["splits"].get(split, {"test": []})["test"]
    return frozenset(name for name in facts["targets"] if name.rpartition("/")[0] in cameras) or None


def match_release(scene: Scene) -> Match | None:
    """Return how a scene compares with the current release's of the same id by its fingerprint, the nearest of several.

    None where the release has the scene's revision, has none of the id, or has no fingerprint of it.
    """
    known = current_release().revisions(scene.id)
    if scene.revision in known:
        return None
    found = []
    for revision in known:
        if (path := fingerprint_path(scene.id, revision)).is_file():
            _check_frozen(FOLDER, path)
            match = compare(scene, read_fingerprint(path))
            found += [match] if match.revision == revision else []
    return min(found, key=lambda match: (not match.is_equivalent, match.bits), default=None)


def is_equivalent(scene: Scene) -> bool:
    """Return whether a scene differs from the release's by rounding alone."""
    match = match_release(scene)
    return match is not None and match.is_equivalent


def with_equivalents(record: Record, scenes: Sequence[Scene]) -> Record:
    """Return a record that names those of its scenes that are equivalent to the release's, as far as they are given."""
    found = {}
    for scene in scenes:
        if record["dataset"]["scenes"].get(scene.id) == scene.revision and (match := match_release(scene)):
            if match.is_equivalent:
                found[scene.id] = {"revision": match.revision, "bits": match.bits}
    dataset = {key: value for key, value in record["dataset"].items() if key != "equivalent"}
    return {**record, "dataset": {**dataset, **({"equivalent": found} if found else {})}}


def release_line(scenes: Sequence[Scene]) -> str | None:
    """Return which of some scenes are those of the current release, in one line; None where it has none of them."""
    known = {scene: revisions for scene in scenes if (revisions := current_release().revisions(scene.id))}
    found: dict[str, list[str]] = {}
    for scene, revisions in known.items():
        match = match_release(scene)
        if scene.revision in revisions:
            found.setdefault("as released", []).append(scene.id)
        elif match and match.is_equivalent:
            found.setdefault("equivalent, by rounding", []).append(f"{scene.id} ({match.bits:.3%} of the bits differ)")
        else:
            why = match.reasons[0] if match else "no fingerprint to compare with"
            found.setdefault("another scene, so on a local board", []).append(f"{scene.id} ({why})")
    parts = [f"{kind}: {', '.join(names)}" for kind, names in found.items()]
    return f"release {RELEASE}: {'; '.join(parts)}" if parts else None


def on_release(dataset: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record's dataset with the release's revisions of equivalent scenes."""
    equal = {scene: found["revision"] for scene, found in dataset.get("equivalent", {}).items()}
    return {"name": dataset["name"], "scenes": {**dataset["scenes"], **equal}, "split": dataset["split"]}


def current_release() -> Release:
    """Return the release that this version ships: it decides where records belong."""
    return read_release(FOLDER, RELEASE)


def track_scenes(name: str) -> dict[str, str]:
    """Return the revisions of a track's scenes by their ids, for downloads.

    Raises UserError for an unknown track, and for one whose scenes are not released yet.
    """
    tracks = {track.name: track for track in current_release().tracks}
    if name not in tracks:
        raise unknown("track", name, tracks)
    scenes = {scene: revision for scene, revision in tracks[name].scenes.items() if revision is not None}
    if tracks[name].announced:
        raise problem("track", "one whose scenes are released", f"{name}, which is only announced", "choose another")
    return scenes


def dataset_revision(dataset: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a record's or a track's scenes with their revisions and of its split, as hex digits."""
    return sha256_json({"scenes": dict(dataset["scenes"]), "split": dataset["split"]})


def short(revision: str) -> str:
    """Return the first digits of a revision, for paths and messages."""
    return revision[:REVISION_DIGITS]


def scene_name(scene: str, revision: str) -> str:
    """Return the name of a released scene: its id and the first digits of its revision.

    >>> scene_name("car-0-small", "b6785e89cd0396d9")
    'car-0-small@b6785e89cd03'
    """
    return f"{scene}@{short(revision)}"


def place_of(record: Mapping[str, Any]) -> Place:
    """Return where a record's entry belongs.

    Raises UserError where a scene's id cannot be part of a file name, and where the dataset's name is not its scenes'.
    """
    dataset, release = on_release(record["dataset"]), current_release()
    ids = sorted(dataset["scenes"])
    for scene in ids:
        if not is_id(scene):
            fix = "correct the scene's id and score again"
            raise problem("the record's dataset", "scene ids of letters, digits and . _ -", repr(scene[:120]), fix)
    if dataset["name"] != "+".join(ids):
        fix = "score the predictions again"
        raise problem("the record's dataset", f"the name {'+'.join(ids)[:120]}", repr(dataset["name"][:120]), fix)
    revision = short(dataset_revision(dataset))
    same = [t for t in release.tracks if t.scenes == dataset["scenes"] and t.split == dataset["split"]]
    given = set(record["method"].get("given", DEFAULT_GIVEN))
    changed = is_changed(record["method"]["name"])
    if boards := tuple(t.name for t in same if not (t.withheld | OTHER_SENSORS) & given and not changed):
        return Place(f"{PUBLIC}/{release.number}-{same[0].name}@{revision}", boards, "")
    more = f"+{len(ids) - 1}" if len(ids) > 1 else ""
    return Place(f"{LOCAL}/{ids[0]}{more}@{revision}", (), CHANGED if changed else why_local(dataset, release, same))


def why_local(dataset: Mapping[str, Any], release: Release, same: list[Track]) -> str:
    """Return the reason why a record belongs to no track; `same` are the tracks of its scenes, revisions and split."""
    number = f"release {release.number}"
    if same:
        return f"the method was given what {', '.join(t.name for t in same)} of {number} withholds"
    other = [
        f"{scene}: revision {short(revision)} here, {' or '.join(map(short, known))} in {number}"
        for scene, revision in sorted(dataset["scenes"].items())
        if (known := release.revisions(scene)) and revision not in known
    ]
    if other:
        more = f"; and {len(other) - _NAMED} more" if len(other) > _NAMED else ""
        return f"{'; '.join(other[:_NAMED])}{more}; see make-dataset --check"
    ids = set(dataset["scenes"])
    if announced := [t.name for t in release.tracks if t.announced and ids & set(t.scenes)]:
        return f"{', '.join(announced)} of {number} takes no entries yet"
    if splits := sorted({t.split for t in release.tracks if set(t.scenes) == ids}):
        return f"split {dataset['split']} here, {', '.join(splits)} in {number}"
    return f"no track of {number} has exactly these scenes"
