from __future__ import annotations

import copy
import hashlib
from pathlib import Path
from typing import Any

import pytest
from changes import edit_json
from hypothesis import given, settings
from hypothesis import strategies as st
from submissions import track, write_release

from spike4dgs.benchmark.errors import UserError
from spike4dgs.leaderboard import tracks
from spike4dgs.leaderboard.tracks import RELEASE, current_release, dataset_revision, place_of

NAMES = {"ideal", "no-flat-field", "uncalibrated", "quick-start", "small", "paper"}


def record_of(scenes: dict[str, str], split: str = "center", name: str | None = None, **method: Any) -> dict[str, Any]:
    dataset = {"name": "+".join(sorted(scenes)) if name is None else name, "scenes": scenes, "split": split}
    return {"dataset": dataset, "method": {"name": "m", "seed": 0, **method}}


def of_track(name: str) -> dict[str, str]:
    (found,) = (t for t in current_release().tracks if t.name == name)
    return {scene: str(revision) for scene, revision in found.scenes.items()}


def test_the_shipped_release_has_the_tracks_and_its_frozen_bytes() -> None:
    assert {t.name for t in current_release().tracks} == NAMES
    listed = (tracks.FOLDER / "SHA256SUMS").read_text().splitlines()
    files = [path for pattern in ("*.json", "*/*.npz") for path in tracks.FOLDER.glob(pattern)]
    found = {p.relative_to(tracks.FOLDER).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
    assert {line[66:]: line[:64] for line in listed} == found
    assert {t.name for t in current_release().tracks if t.announced} == {"paper"}
    every = {(s, r) for t in current_release().tracks for s, r in t.scenes.items() if r is not None}
    assert {f"2/{tracks.scene_name(*pair)}.npz" for pair in every} <= found.keys(), "each scene has a fingerprint"
    assert {tracks.scene_name(*pair) for pair in every} == set(current_release().ceilings_db)


def test_the_sensor_of_a_releases_scene_is_known_for_its_revision_alone() -> None:
    release = current_release()
    scenes = release.tracks[0].scenes
    assert all(release.sensor(scene, str(revision)) == "noisy" for scene, revision in scenes.items())
    assert release.sensor("car-0-small", "0" * 64) is None


def test_a_release_that_was_edited_is_refused(tmp_path: Path) -> None:
    folder = write_release(tmp_path, {"a": track({"s": "0" * 64})})
    assert tracks.read_release(folder, RELEASE).tracks[0].scenes == {"s": "0" * 64}
    tracks.read_release.cache_clear()
    edit_json(folder / f"{RELEASE}.json", lambda r: r["tracks"]["a"]["scenes"].update(s="1" * 64))
    with pytest.raises(UserError, match=r"2\.json: expected the bytes whose hash SHA256SUMS lists"):
        tracks.read_release(folder, RELEASE)


@pytest.mark.parametrize(
    "change",
    [
        lambda r: r["tracks"].update({"../x": track({"s": "0" * 64})}),
        lambda r: r["tracks"]["a"]["scenes"].update({"a/b": "0" * 64}),
        lambda r: r["tracks"]["a"]["scenes"].update(s=None),
        lambda r: r["tracks"]["a"].update(withheld=["everything"]),
        lambda r: r["ceilings_db"].update({f"s@{'0' * 12}": 1e9}),
        lambda r: r["ceilings_db"].update({"s@0123": 50.0}),
    ],
)
def test_a_release_follows_its_schema(tmp_path: Path, change: Any) -> None:
    path = write_release(tmp_path, {"a": track({"s": "0" * 64})}) / f"{RELEASE}.json"
    edit_json(path, change)
    (tmp_path / "SHA256SUMS").write_text(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n")
    with pytest.raises(UserError, match="expected a valid spike4dgs-release/1"):
        tracks.read_release(tmp_path, RELEASE)


def test_a_tracks_scenes_and_revisions_are_public_and_the_path_carries_the_revision() -> None:
    scenes = of_track("ideal")
    place = place_of(record_of(scenes))
    revision = dataset_revision({"scenes": scenes, "split": "center"})
    assert place.folder == f"entries/2-ideal@{revision[:12]}" and place.tracks == ("ideal",)
    both = place_of(record_of(scenes, given=["poses"]))
    assert both.folder == place.folder and both.tracks == ("ideal", "no-flat-field")
    outdoor = of_track("uncalibrated")
    assert place_of(record_of(outdoor, given=["flat-field"])).tracks == ("uncalibrated",)
    assert "was given what uncalibrated" in place_of(record_of(outdoor)).why


def test_tracks_may_have_two_revisions_of_a_scene() -> None:
    """`quick-start` renders car and turntable as `make-dataset` does by default, the other tracks with less noise."""
    release = current_release()
    ideal, quick = of_track("ideal")["car-0-small"], of_track("quick-start")["car-0-small"]
    assert release.revisions("car-0-small") == (ideal, quick) and ideal != quick
    assert release.sensor("car-0-small", ideal) == release.sensor("car-0-small", quick) == "noisy"
    first, second = (release.ceiling_db("car-0-small", revision) for revision in (ideal, quick))
    assert first is not None and second is not None and first > second + 2
    assert release.revisions("car-0-paper") == () and release.ceiling_db("car-0-small", "0" * 64) is None


def test_anything_else_is_local_and_says_why() -> None:
    scenes, known = of_track("ideal"), of_track("ideal")["car-0-small"]
    other = place_of(record_of({**scenes, "car-0-small": "ab" * 32}))
    assert not other.is_public and other.folder.startswith("local/bicycle-0-small+8@")
    quick = of_track("quick-start")["car-0-small"][:12]
    expected = f"{known[:12]} or {quick} in release 2"
    assert other.why == f"car-0-small: revision {'ab' * 6} here, {expected}; see make-dataset --check"
    assert place_of(record_of(scenes, split="corner")).why == "split corner here, center in release 2"
    assert place_of(record_of({"car-0-small": known})).why == "no track of release 2 has exactly these scenes"
    paper = place_of(record_of({"car-0-paper": "0" * 64}))
    assert paper.why == "paper of release 2 takes no entries yet"
    changed = place_of({**record_of(scenes), "method": {"name": "m[a.b=1]", "seed": 0}})
    assert not changed.is_public and "--set" in changed.why
    assert len({p.folder for p in (other, paper, place_of(record_of(scenes, split="corner")))}) == 3


def test_a_method_that_was_given_what_every_track_withholds_is_local(tmp_path: Path, monkeypatch: Any) -> None:
    release = write_release(tmp_path, {"unposed": track({"s": "0" * 64}, ("poses",))})
    monkeypatch.setattr(tracks, "FOLDER", release)
    assert "was given what unposed" in place_of(record_of({"s": "0" * 64})).why
    assert place_of(record_of({"s": "0" * 64}, given=[])).tracks == ("unposed",)


@pytest.mark.parametrize("kind", ["frames", "events"])
def test_what_no_revision_covers_is_on_no_board(kind: str) -> None:
    place = place_of(record_of(of_track("ideal"), given=["poses", kind]))
    assert not place.is_public and "was given what ideal" in place.why


ids = st.text(min_size=1, max_size=120)


@settings(deadline=None)
@given(ids, st.text(max_size=60))
def test_no_id_or_name_leads_out_of_the_folder(scene: str, name: str) -> None:
    for record in (record_of({scene: "0" * 64}), record_of({"a": "0" * 64}, name=name)):
        try:
            folder = place_of(record).folder
        except UserError as e:
            assert "\n" not in str(e)
            continue
        parts = Path(folder).parts
        assert len(parts) == 2 and parts[0] == "local" and not parts[1].startswith(".") and ".." not in parts


@settings(deadline=None)
@given(st.dictionaries(st.sampled_from("abcdef"), st.sampled_from(["0" * 64, "1" * 64]), min_size=1))
def test_equal_paths_mean_equal_scenes_and_revisions(scenes: dict[str, str]) -> None:
    folder = place_of(record_of(scenes)).folder
    for scene in scenes:
        changed = copy.deepcopy(scenes) | {scene: "2" * 64}
        assert place_of(record_of(changed)).folder != folder
    assert place_of(record_of(dict(reversed(scenes.items())))).folder == folder
