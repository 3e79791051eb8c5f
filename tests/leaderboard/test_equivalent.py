"""Results of scenes that another processor made: on the track where they are equivalent, on a local board otherwise."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changes import edit_json
from submissions import board, edit_with_ledger, enter, raise_metric, read, track, write_release

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.release.fingerprint import make_fingerprint, write_fingerprint
from spike4dgs.benchmark.scene.images import write_exr
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.leaderboard import tracks
from spike4dgs.leaderboard.page.pictures import write_pictures
from spike4dgs.leaderboard.page.rows import gather
from spike4dgs.leaderboard.tracks import RELEASE, current_release, match_release, release_line, scene_name
from spike4dgs.leaderboard.verify import verify_record
from spike4dgs.leaderboard.verify_entries import verify_leaderboard

SCENES = ("s0", "s1")


def ship(done: Path, monkeypatch: pytest.MonkeyPatch, share: float) -> Path:
    """Ship a release of the run's scenes, with `share` of the spike bits of the training views of s0 changed, and
    with other last bits in half of its truth."""
    data = done / "released"
    for name in SCENES:
        shutil.copytree(done / name, data / name)
    scene = open_scene(data / "s0")
    for path in sorted((data / "s0/spikes").glob("cam_0[0-2].dat")):
        bits = np.unpackbits(np.fromfile(path, np.uint8))
        bits ^= np.random.default_rng(0).random(bits.shape) < share
        np.packbits(bits).tofile(path)
    for target in scene.targets:
        bits = scene.ground_truth(target).astype(np.float16).view(np.uint16)
        bits[::2] ^= 1
        image = bits.view(np.float16).astype(np.float32)
        write_exr(data / f"s0/images/{target.name}.exr", image, scene.t_us(target.tick))
    write_manifest(data / "s0")
    scenes = [open_scene(data / name) for name in SCENES]
    folder = write_release(done / "releases", {"patterns": track({s.id: s.revision for s in scenes})})
    prints = {f"{RELEASE}/{scene_name(s.id, s.revision)}.npz": s for s in scenes}
    for name, scene in prints.items():
        write_fingerprint(folder / name, make_fingerprint(scene))
    names = [f"{RELEASE}.json", *prints]
    lines = [f"{hashlib.sha256((folder / name).read_bytes()).hexdigest()}  {name}\n" for name in names]
    (folder / "SHA256SUMS").write_text("".join(lines))
    monkeypatch.setattr(tracks, "FOLDER", folder)
    tracks.read_release.cache_clear()
    return data


def test_a_result_of_equivalent_scenes_is_on_the_track_and_says_so(
    done: Path, monkeypatch: pytest.MonkeyPatch, said: Any
) -> None:
    data = ship(done, monkeypatch, 1e-4)
    entry = read(enter(done))
    assert "place 1 of 1 by mean PSNR on patterns (release 2" in (said := said())
    assert "on equivalent scenes (bits that differ: pattern-0 0.0" in said
    dataset = entry["record"]["dataset"]
    own, released = (open_scene(folder / "s0") for folder in (done, data))
    assert dataset["scenes"]["pattern-0"] == own.revision
    assert dataset["equivalent"].keys() == {"pattern-0"}
    assert dataset["equivalent"]["pattern-0"]["revision"] == released.revision != own.revision
    (found,) = board(done, "leaderboard")["boards"]
    assert found["dataset"]["scenes"] == dict(current_release().tracks[0].scenes)
    assert 0 < found["rows"][0]["equivalent"]["pattern-0"] < 1e-3
    line = release_line([open_scene(done / name) for name in SCENES])
    assert line is not None and "as released: pattern-1" in line and "equivalent, by rounding: pattern-0 (0.0" in line


@pytest.mark.parametrize("folder", ["own", "released"])
def test_it_is_scored_again_on_its_own_scenes_and_on_the_releases(
    folder: str, done: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = ship(done, monkeypatch, 1e-4)
    path = enter(done)
    scenes = [(done if folder == "own" else data) / name for name in SCENES]
    found = verify_leaderboard(done / "board", done / "out/predictions", scenes)
    assert (found.scored, found.problems) == (1, ())
    edit_with_ledger(path, lambda entry: raise_metric(entry["record"], "psnr", 0.5))
    found = verify_leaderboard(done / "board", done / "out/predictions", scenes)
    assert any("mean" in problem or "psnr" in problem for problem in found.problems)


def test_the_run_stands_on_the_track_with_its_images(done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the entry is on the page's leaderboard, and where `run-benchmark` alone made it."""
    ship(done, monkeypatch, 1e-4)
    for name in ("bad", "rough"):
        (done / f"out/results/{name}.json").unlink()
    enter(done)
    shutil.copytree(done / "board", done / "out/leaderboard")
    for leaderboard, method in (("board", "tfp+4dgs"), ("none", "out/tfp+4dgs")):
        (found,) = gather(done / leaderboard, (done / "out",))[0]
        (row,) = found.rows
        assert (found.name, row.name, set(row.predictions)) == ("patterns", method, set(found.scenes))
    for name in SCENES:
        (done / name).rename(done / open_scene(done / name).id)
    said = list[str]()
    pictures = write_pictures(done / "page", found, 0, done, set(), said.append)
    assert [of["rows"] for of in pictures] == [[0], [0]] and not said


def test_another_noise_is_on_a_local_board(done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ship(done, monkeypatch, 0.1)
    entry = read(enter(done))
    assert "equivalent" not in entry["record"]["dataset"]
    assert "revision" in board(done)["boards"][0]["why"]
    match = match_release(open_scene(done / "s0"))
    assert match is not None and not match.is_equivalent
    line = release_line([open_scene(done / "s0")])
    assert line is not None and "another scene, so on a local board: pattern-0 (" in line


def claimed(data: Path) -> dict[str, Any]:
    """What a record would state of s0, had it the released bits."""
    return {"pattern-0": {"revision": open_scene(data / "s0").revision, "bits": 0.0}}


def test_a_record_cannot_claim_it(done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    claim = claimed(ship(done, monkeypatch, 0.1))
    edit_json(done / "out/results/tfp+4dgs.json", lambda record: record["dataset"].update(equivalent=claim))
    for verified in (False, True):
        entry = read(enter(done, verified=verified, replace=True))
        assert "equivalent" not in entry["record"]["dataset"]
    assert not board(done, "leaderboard")["boards"]


def test_an_entry_that_claims_it_fails_when_its_scenes_are_compared(
    done: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    claim, scenes = claimed(ship(done, monkeypatch, 0.1)), [open_scene(done / name) for name in SCENES]
    record = read(path := enter(done))["record"]
    record["dataset"]["equivalent"] = claim
    with pytest.raises(UserError, match="expected a scene that is equivalent to revision .*% of the spike bits differ"):
        verify_record(record, path, done / "out/predictions/tfp+4dgs", scenes)


def test_an_entry_has_the_releases_targets_on_whichever_board(done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An image of one entry alone, with the mean's values, would change no mean."""
    ship(done, monkeypatch, 1e-4)
    path = enter(done)

    def add(entry: dict[str, Any]) -> None:
        cell = entry["record"]["scenes"]["pattern-0"]
        cell["per_image"]["cam_03/999999"] = dict(cell["metrics"])

    edit_with_ledger(path, add)
    with pytest.raises(UserError, match=r"scores of the 3 targets of the release, found .*: cam_03/999999"):
        read(path)


def test_a_fingerprint_that_was_exchanged_is_refused(done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ship(done, monkeypatch, 0.1)
    (path,) = (tracks.FOLDER / RELEASE).glob("pattern-0@*.npz")
    write_fingerprint(path, make_fingerprint(open_scene(done / "s0")))
    with pytest.raises(UserError, match=r"pattern-0@.*\.npz: expected the bytes whose hash SHA256SUMS lists"):
        match_release(open_scene(done / "s0"))
