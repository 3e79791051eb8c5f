"""Uploads to servers on this machine that speak as the hosts do."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from changes import files_in
from upload_server import TOKEN, Hub, Server, Zenodo, serve_uploads

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.release import publish
from spike4dgs.benchmark.release.check import find_problems
from spike4dgs.benchmark.release.index import Release, read_release
from spike4dgs.benchmark.release.pack import pack
from spike4dgs.benchmark.release.publish import TOKENS, plan
from spike4dgs.benchmark.scene.scene import open_scenes
from spike4dgs.cli import main


@pytest.fixture(autouse=True)
def tokens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publish, "_WAIT_S", 0.001)
    for name in TOKENS.values():
        monkeypatch.setenv(name, TOKEN)


@pytest.fixture(scope="module")
def flat(scene_folders: tuple[Path, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The release in one folder."""
    out = tmp_path_factory.mktemp("flat") / "1"
    pack(open_scenes(scene_folders), out, "1", 6_000_000, flat=True)
    return out


def contents(root: Path) -> dict[str, bytes]:
    return {name: (root / name).read_bytes() for name in files_in(root)}


def test_a_flat_release_has_no_folders_and_is_good(flat: Path, release: Release) -> None:
    assert not [path for path in flat.rglob("*") if path.is_dir()]
    assert not list(find_problems(flat))
    found = read_release(flat)
    assert found.scenes == release.scenes
    assert [s.sha256 for s in found.shards] == [s.sha256 for s in release.shards]


def test_a_web_server_gets_every_file_and_the_index_last(release_folder: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    """Byte for byte what lies in the folder, which tests of downloads read."""
    with serve_uploads(Server) as (address, host):
        assert main(["release", "publish", str(release_folder), "--to", f"{address}/data/1"]) == 0
    assert host.files == {f"/data/1/{name}": text for name, text in contents(release_folder).items()}
    assert host.puts()[-1] == "/data/1/release.json"
    sha256 = read_release(release_folder).sha256
    assert f"download all --from {address}/data/1 --sha256 {sha256}" in capsys.readouterr().out


def test_zenodo_gets_a_draft_with_metadata_and_every_file(flat: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    with serve_uploads(Zenodo) as (address, host):
        assert main(["release", "publish", str(flat), "--to", f"zenodo+{address}"]) == 0
    assert host.files == contents(flat)
    assert host.draft is not None
    metadata = host.draft["metadata"]
    assert (metadata["upload_type"], metadata["license"], metadata["version"]) == ("dataset", "cc0-1.0", "1")
    assert metadata["creators"] and read_release(flat).sha256 in metadata["notes"]
    assert not any("publish" in request for request in host.requests), "a person publishes"
    assert "DOI 10.5281/zenodo.7" in capsys.readouterr().out


def test_a_draft_is_sent_only_what_it_lacks_and_loses_what_an_earlier_try_left_there(flat: Path) -> None:
    with serve_uploads(Zenodo) as (address, host):
        assert main(["release", "publish", str(flat), "--to", f"zenodo+{address}"]) == 0
        assert host.draft is not None
        first = len(host.puts())
        host.draft["files"] = [f for f in host.draft["files"] if f["filename"] != "release.json"]
        host.draft["files"].append({"id": "f-spike4dgs-1-00099.tar", "filename": "spike4dgs-1-00099.tar"})
        host.files["spike4dgs-1-00099.tar"] = b"of other scenes"
        assert main(["release", "publish", str(flat), "--to", f"zenodo+{address}"]) == 0
        assert host.puts()[first:] == ["/api/deposit/depositions/7", "/api/files/b-7/release.json"]
        assert host.requests.count("POST /api/deposit/depositions") == 1
    assert host.files == contents(flat)


def test_the_hub_gets_a_dataset_of_every_file_and_keeps_no_other_shard(release_folder: Path) -> None:
    with serve_uploads(Hub) as (address, host):
        host.files = {"shards/000/spike4dgs-1-00099.tar": b"of other scenes", ".gitattributes": b"of the host"}
        told = {"HF_ENDPOINT": address, "HF_TOKEN": TOKEN, "HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_TELEMETRY": "1"}
        command = ["release", "publish", str(release_folder), "--to", "hf://datasets/owner/name"]
        done = subprocess.run(  # the client reads the variables when it is imported
            [sys.executable, "-m", "spike4dgs.cli", *command], env=os.environ | told, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
    assert host.files == {**contents(release_folder), ".gitattributes": b"of the host"}
    assert "download all --from hf://datasets/owner/name" in done.stdout


@pytest.mark.parametrize("kind", ["server", "zenodo", "hub"])
def test_a_dry_run_shows_every_byte_and_sends_nothing(
    kind: str, flat: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in TOKENS.values():
        monkeypatch.delenv(name)
    with serve_uploads(Zenodo) as (address, host):
        target = {"server": f"{address}/1", "zenodo": f"zenodo+{address}", "hub": "hf://datasets/owner/name"}[kind]
        assert main(["release", "publish", str(flat), "--to", target, "--dry-run"]) == 0
        assert not host.requests
    printed = capsys.readouterr().out
    sums = dict(reversed(line.split("  ")) for line in (flat / "SHA256SUMS").read_text().splitlines())
    assert len(sums) >= 6
    for name, sha256 in sums.items():
        assert f"{name}  {(flat / name).stat().st_size} bytes, sha256 {sha256}" in printed
    assert f"{sum(map(len, contents(flat).values()))} bytes" in printed
    if kind == "zenodo":
        start, stop = printed.index("{"), printed.index("PUT BUCKET")
        assert json.loads(printed[start:stop])["metadata"]["license"] == "cc0-1.0"


def test_a_busy_host_is_asked_again(release_folder: Path) -> None:
    with serve_uploads(Server) as (address, host):
        host.failures = [503, 429]
        assert main(["release", "publish", str(release_folder), "--to", address]) == 0
        assert len(host.puts()) == len(contents(release_folder)) + 2


@pytest.mark.parametrize(
    ("failures", "expected", "asked"),
    [([503] * 10, "503", 5), ([403], "403 Forbidden", 1), ([302], "302", 1), ([], "bytes after the upload", 2)],
)
def test_a_host_that_fails_or_keeps_other_bytes_is_one_line(
    release_folder: Path, capsys: pytest.CaptureFixture[str], failures: list[int], expected: str, asked: int
) -> None:
    with serve_uploads(Server) as (address, host):
        host.failures, host.spoil = failures, not failures
        assert main(["release", "publish", str(release_folder), "--to", address]) == 2
        assert len(host.requests) == asked
    assert expected in capsys.readouterr().err


def test_zenodo_that_answers_another_checksum_is_refused(flat: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serve_uploads(Zenodo) as (address, host):
        host.spoil = True
        assert main(["release", "publish", str(flat), "--to", f"zenodo+{address}"]) == 2
    assert "expected md5" in capsys.readouterr().err


def test_a_missing_or_wrong_token_is_one_line(
    release_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with serve_uploads(Server) as (address, host):
        monkeypatch.setenv("SPIKE4DGS_UPLOAD_TOKEN", "other")
        assert main(["release", "publish", str(release_folder), "--to", address]) == 2
        assert "401" in capsys.readouterr().err and not host.files
        monkeypatch.delenv("SPIKE4DGS_UPLOAD_TOKEN")
        assert main(["release", "publish", str(release_folder), "--to", address]) == 2
    assert "SPIKE4DGS_UPLOAD_TOKEN: expected a token" in capsys.readouterr().err


def test_a_damaged_release_is_not_sent(flat: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = tmp_path / "1"
    copy.mkdir()
    for name, text in contents(flat).items():
        (copy / name).write_bytes(text)
    (copy / "DATASHEET.md").write_text("another")
    with serve_uploads(Server) as (address, host):
        assert main(["release", "publish", str(copy), "--to", address]) == 2
        assert not host.requests
    assert "DATASHEET.md: expected sha256" in capsys.readouterr().err


def test_other_addresses_and_what_zenodo_does_not_take_are_refused(release_folder: Path, release: Release) -> None:
    for target in ("http://example.org/1", "ftp://example.org", "zenodo+http://example.org", "data"):
        with pytest.raises(UserError, match="^--to: expected"):
            plan(release_folder, release, target)
    with pytest.raises(UserError, match="pack it again with --flat"):
        plan(release_folder, release, "zenodo")


def test_scenes_of_unknown_licences_are_refused(release_folder: Path, release: Release) -> None:
    for licences in (("unknown", "unknown"), ("CC0-1.0", "MIT")):
        pairs = zip(release.scenes.items(), licences, strict=True)
        other = replace(release, scenes={id: replace(scene, licence=licence) for (id, scene), licence in pairs})
        with pytest.raises(UserError, match="scenes of one licence"):
            plan(release_folder, other, "https://example.org/1")


def test_the_datasheet_names_every_scene_with_its_licence(release_folder: Path, release: Release) -> None:
    text = (release_folder / "DATASHEET.md").read_text()
    for scene in release.scenes.values():
        assert f"{scene.id} ({scene.title}): {scene.licence}" in text
    for heading in ("Motivation", "Composition", "Collection", "Uses", "Distribution", "Maintenance"):
        assert f"## {heading}" in text
