"""Upload a release: to Hugging Face, to Zenodo, or to a web server that takes PUT.

What is sent is planned first, from the folder alone, and can be shown without a token: every request, with the bytes
and the SHA-256 of its file. `release.json` comes last of the files: without it a folder is no release yet.

Zenodo's legacy REST API (https://developers.zenodo.org) makes a draft, takes its metadata and the files, and answers
each with its MD5. The draft is left for a person to publish: only then its DOI is registered. Zenodo has no folders and
takes 100 files of 50 GB in all; `release pack --flat` writes such a release.
"""

from __future__ import annotations

import hashlib
import html
import json
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import quote
from urllib.request import HTTPRedirectHandler, Request, build_opener

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import sha256_file
from spike4dgs.benchmark.release import card, index
from spike4dgs.benchmark.release.index import Release
from spike4dgs.benchmark.release.pack import SUMS
from spike4dgs.benchmark.release.source import ByteProgress, size_text

ZENODO = {"zenodo": "https://zenodo.org", "zenodo-sandbox": "https://sandbox.zenodo.org"}
_MARK = "zenodo+"  # before the address of another server with Zenodo's API
_HUB = "hf://datasets/"
TOKENS = {"zenodo": "ZENODO_TOKEN", "hub": "HF_TOKEN", "server": "SPIKE4DGS_UPLOAD_TOKEN"}
MOST_FILES, MOST_BYTES = 100, 50_000_000_000  # of a Zenodo record
_OPEN = ("CC0-1.0", "CC-BY-4.0", "CC-BY-SA-4.0", "Apache-2.0", "MIT")  # licences by which a release may be published
_TRIES, _WAIT_S, _TIMEOUT_S = 5, 0.5, 120
_MOST_BYTES = 64 << 20  # of a host's answer
_PASSES = (408, 425, 429, 500, 502, 503, 504)  # answers that may be others the next time


@dataclass(frozen=True)
class Sent:
    """A file that is sent."""

    name: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class Upload:
    """What is sent where. `kind`: zenodo, hub or server; `address`: of the site, the repository or the folder."""

    kind: str
    address: str
    files: tuple[Sent, ...]
    licence: str
    metadata: Mapping[str, Any] = field(default_factory=dict)  # of a Zenodo record

    @property
    def bytes(self) -> int:
        """The size of all files."""
        return sum(file.bytes for file in self.files)

    def lines(self) -> Iterator[str]:
        """Yield the requests as text: what a dry run shows."""
        if self.kind == "zenodo":
            yield f"GET {self.address}/api/deposit/depositions?status=draft"
            yield f"POST {self.address}/api/deposit/depositions, or PUT to the draft that has this title"
            yield from json.dumps({"metadata": self.metadata}, indent=2).splitlines()
        if self.kind == "hub":
            yield f"create the dataset repository {self.address.removeprefix(_HUB)}, and commit:"
        where = {"zenodo": "PUT BUCKET/", "hub": "", "server": f"PUT {self.address}/"}[self.kind]
        for file in self.files:
            yield f"{where}{quote(file.name)}  {file.bytes} bytes, sha256 {file.sha256}"


def plan(root: Path, release: Release, target: str) -> Upload:
    """Return the upload of a checked release to `target`; nothing is sent.

    `target` is zenodo, zenodo-sandbox, zenodo+https://HOST, hf://datasets/OWNER/NAME or the https:// address of a
    folder. Raises UserError for another one, for licences that do not allow it, and for what the host does not take.
    """
    kind, address = _kind(target)
    licences = {scene.licence for scene in release.scenes.values()}
    if len(licences) > 1 or not licences <= set(_OPEN):
        found = ", ".join(sorted(licences))
        raise problem(root, f"scenes of one licence among {', '.join(_OPEN)}", found, "pack those scenes alone")
    names = [*card.NAMES, SUMS, *(name for s in release.shards for name in (s.file, s.index)), index.NAME]
    files = tuple(Sent(name, (root / name).stat().st_size, sha256_file(root / name)) for name in names)
    licence = licences.pop()
    upload = Upload(kind, address, files, licence, _metadata(release, licence) if kind == "zenodo" else {})
    if kind == "zenodo":
        if folders := [file.name for file in files if "/" in file.name]:
            raise problem(root, "files in one folder, for Zenodo", folders[0], "pack it again with --flat")
        if len(files) > MOST_FILES or upload.bytes > MOST_BYTES:
            expected = f"at most {MOST_FILES} files and {size_text(MOST_BYTES)}, for Zenodo"
            raise problem(
                root, expected, f"{len(files)}, {size_text(upload.bytes)}", "pack fewer scenes, or larger tars"
            )
    return upload


def _kind(target: str) -> tuple[str, str]:
    if target in ZENODO:
        return "zenodo", ZENODO[target]
    for start, kind in ((_MARK + "https://", "zenodo"), (_MARK + "http://127.0.0.1:", "zenodo"), (_HUB, "hub")):
        if target.startswith(start):
            return kind, target.removeprefix(_MARK).rstrip("/")
    if target.startswith(("https://", "http://127.0.0.1:")):  # a token never goes through a network in the clear
        return "server", target.rstrip("/")
    expected = f"{', '.join(ZENODO)}, {_HUB}OWNER/NAME or https://HOST/FOLDER"
    raise problem("--to", expected, repr(target), "correct the address")


def _metadata(release: Release, licence: str) -> dict[str, Any]:
    """Return what Zenodo's DOI says of the release."""
    scenes = "".join(f"<li>{html.escape(s.id)}: {html.escape(s.title)}</li>" for s in release.scenes.values())
    use = "<p>spike4dgs download all --from ADDRESS --out data</p>"
    return {
        "title": f"Spike4DGS, release {release.name}: scenes of spike-camera arrays",
        "upload_type": "dataset",
        "description": f"<p>{html.escape(card.description(list(release.scenes.values())))}</p><ul>{scenes}</ul>{use}",
        "creators": [{"name": "The Spike4DGS developers"}],
        "access_right": "open",
        "license": licence.lower(),
        "version": release.name,
        "language": "eng",
        "keywords": ["spike camera", "neuromorphic vision", "dynamic view synthesis", "benchmark"],
        "notes": f"release.json has sha256 {release.sha256}",
        "prereserve_doi": True,
    }


def token_of(upload: Upload) -> str:
    """Return the token of an upload's host, from the environment. Raises UserError where there is none."""
    name = TOKENS[upload.kind]
    if not (token := os.environ.get(name)):
        raise problem(name, f"a token for {upload.address}", "none", "set it, or look at what is sent with --dry-run")
    return token


def send(root: Path, upload: Upload, token: str) -> str:
    """Send a release and return where it lies. Raises UserError where the host refuses, or keeps failing.

    Run again after a failure, files that Zenodo or Hugging Face have are not sent again. What they have of another try
    and is not in the release goes: all other files of the Zenodo draft, and shards of a repository.
    """
    if upload.kind == "hub":
        return _to_hub(root, upload, token)
    with ByteProgress("uploading", upload.bytes) as progress:
        return (_to_zenodo if upload.kind == "zenodo" else _to_server)(root, upload, token, progress)


def _to_server(root: Path, upload: Upload, token: str, progress: ByteProgress) -> str:
    for file in upload.files:
        address = f"{upload.address}/{quote(file.name)}"
        _ask("PUT", address, token, root / file.name)
        length = _ask("HEAD", address, token)[1].get("Content-Length")
        if length != str(file.bytes):
            raise problem(address, f"{file.bytes} bytes after the upload", f"{length}", "look at the server's log")
        progress.advance(file.bytes)
    return upload.address


def _to_zenodo(root: Path, upload: Upload, token: str, progress: ByteProgress) -> str:
    api = f"{upload.address}/api/deposit/depositions"
    drafts = _json(_ask("GET", f"{api}?status=draft&size=100", token)[0], api)
    mine = [d for d in drafts if isinstance(d, dict) and d.get("metadata", {}).get("title") == upload.metadata["title"]]
    body = {"metadata": dict(upload.metadata)}
    draft = mine[0] if mine else _json(_ask("POST", api, token, body=body)[0], api)
    try:
        address, bucket = f"{api}/{int(draft['id'])}", str(draft["links"]["bucket"])
    except (KeyError, TypeError, ValueError) as e:
        raise problem(api, "a draft with id and links.bucket", repr(e), "look at Zenodo's status page") from None
    if not bucket.startswith(f"{upload.address}/"):  # the token goes nowhere else
        raise problem(api, f"a bucket at {upload.address}", bucket, "look at Zenodo's status page")
    draft = _json(_ask("PUT", address, token, body=body)[0], address)
    there = {str(f.get("filename")): str(f.get("checksum")).removeprefix("md5:") for f in draft.get("files", [])}
    names = {file.name for file in upload.files}
    for stale in (f for f in draft.get("files", []) if f.get("filename") not in names):
        _ask("DELETE", f"{address}/files/{quote(str(stale.get('id')), safe='')}", token)
    for file in upload.files:
        md5 = _md5(root / file.name)
        if there.get(file.name) == md5:
            progress.skip(file.bytes)
            continue
        answer = _json(_ask("PUT", f"{bucket}/{quote(file.name)}", token, root / file.name)[0], bucket)
        if str(answer.get("checksum")).removeprefix("md5:") != md5:
            raise problem(f"{bucket}/{file.name}", f"md5 {md5}", str(answer.get("checksum")), "run the command again")
        progress.advance(file.bytes)
    doi = draft.get("metadata", {}).get("prereserve_doi", {}).get("doi", "none yet")
    print(f"draft {draft['id']}, DOI {doi}: look at it and publish it at {upload.address}/deposit/{draft['id']}")
    return f"{upload.address}/records/{draft['id']}/files"


def _to_hub(root: Path, upload: Upload, token: str) -> str:
    try:
        from huggingface_hub import HfApi
        from huggingface_hub.errors import HfHubHTTPError
    except ImportError:
        raise problem("huggingface_hub", "the package", "none", "pip install 'spike4dgs[download]'") from None
    api, repository = HfApi(endpoint=os.environ.get("HF_ENDPOINT"), token=token), upload.address.removeprefix(_HUB)
    names = [file.name for file in upload.files]
    try:
        api.create_repo(repository, repo_type="dataset", exist_ok=True)
        api.upload_folder(
            repo_id=repository,
            repo_type="dataset",
            folder_path=root,
            allow_patterns=names,
            delete_patterns=[f"*/{index.SHARD}*", f"{index.SHARD}*"],  # of an earlier upload; what is sent stays
            commit_message=f"Spike4DGS release, {len(names)} files",
        )
    except (HfHubHTTPError, OSError, ValueError) as e:
        text = " ".join(str(e).split())[:200]
        raise problem(upload.address, "an upload", text, "check the token and run the command again") from None
    return upload.address


def _ask(
    method: str, address: str, token: str, file: Path | None = None, body: Mapping[str, Any] | None = None
) -> tuple[bytes, Mapping[str, str]]:
    """Return the body and headers of an answer; failures that may pass are tried again, after waits that double."""
    for failures in range(1, _TRIES + 1):
        try:
            return _once(method, address, token, file, body)
        except HTTPError as e:
            found, passes = f"{e.code} {e.reason}: {e.read(200).decode(errors='replace')}", e.code in _PASSES
        except OSError as e:  # URLError too
            found, passes = f"{type(e).__name__} {e}", True
        if not passes or failures == _TRIES:
            fix = "run the command again" if passes else "check the address, the token and its rights"
            raise problem(address, f"{method} to succeed", f"{found}, try {failures}", fix)
        time.sleep(_WAIT_S * 2 ** (failures - 1))
    raise AssertionError("the last try returns or raises")


def _once(
    method: str, address: str, token: str, file: Path | None, body: Mapping[str, Any] | None
) -> tuple[bytes, Mapping[str, str]]:
    headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
    if file is None:
        return _answer(Request(address, None if body is None else json.dumps(body).encode(), headers, method=method))
    headers |= {"Content-Type": "application/octet-stream", "Content-Length": str(file.stat().st_size)}
    with open(file, "rb") as data:
        return _answer(Request(address, data, headers, method=method))


class _Stay(HTTPRedirectHandler):
    """Follows no redirection: it would take the token to another host."""

    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


def _answer(request: Request) -> tuple[bytes, Mapping[str, str]]:
    with build_opener(_Stay).open(request, timeout=_TIMEOUT_S) as answer:
        data: bytes = answer.read(_MOST_BYTES + 1)
        if len(data) > _MOST_BYTES:
            raise problem(request.full_url, f"an answer of {_MOST_BYTES >> 20} MiB at most", "more", "ask the host")
        return data, answer.headers


def _json(text: bytes, where: str) -> Any:
    try:
        return json.loads(text)
    except ValueError as e:
        raise problem(where, "an answer in JSON", str(e), "look at the host's status page") from None


def _md5(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "md5").hexdigest()  # Zenodo's checksum
