"""Servers that take a release: of PUT requests, and of Zenodo's and Hugging Face's interfaces.

They have what uploads use of them, after the hosts' documentation (developers.zenodo.org, git-lfs's batch interface).
"""

import base64
import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from threading import Lock
from typing import Any
from urllib.parse import unquote

from local_server import running

TOKEN = "secret"


@dataclass
class Host:
    """What a server has received, and the statuses of its next answers."""

    files: dict[str, bytes] = field(default_factory=dict)
    requests: list[str] = field(default_factory=list)
    failures: list[int] = field(default_factory=list)
    spoil: bool = False  # stores another byte than it was sent
    draft: dict[str, Any] | None = None
    lock: Any = field(default_factory=Lock)

    def puts(self) -> list[str]:
        return [request.removeprefix("PUT ") for request in self.requests if request.startswith("PUT ")]


@contextmanager
def serve_uploads(kind: type[BaseHTTPRequestHandler]) -> Iterator[tuple[str, Host]]:
    """Serve on a free port of this machine; yield its address and what it received."""
    host = Host()

    class OfThisHost(kind):  # type: ignore[misc, valid-type]
        received = host

    with running(OfThisHost) as address:
        yield address, host


class Server(BaseHTTPRequestHandler):
    """A web server that takes PUT with a bearer's token."""

    protocol_version = "HTTP/1.1"
    received: Host

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""

    def _handle(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        path = unquote(self.path.partition("?")[0])
        with self.received.lock:
            self.received.requests.append(f"{self.command} {path}")
            failure = self.received.failures.pop(0) if self.received.failures else None
        if failure:
            self._send(failure, b"busy")
        elif not self.allowed():
            self._send(401, b"who are you?")
        else:
            self.answer(path, body)

    do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = _handle

    def allowed(self) -> bool:
        return self.headers.get("Authorization") == f"Bearer {TOKEN}"

    def answer(self, path: str, body: bytes) -> None:
        files = self.received.files
        if self.command == "PUT":
            self.store(path, body)
            self._send(201)
        elif path in files:
            self._send(200, b"" if self.command == "HEAD" else files[path], size=len(files[path]))
        else:
            self._send(404)

    def store(self, path: str, body: bytes) -> bytes:
        self.received.files[path] = kept = body[:-1] if self.received.spoil else body
        return kept

    def _send(self, status: int, body: bytes = b"", size: int | None = None) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(body) if size is None else size))
        self.end_headers()
        self.wfile.write(body)

    def send_json(self, value: Any, status: int = 200) -> None:
        self._send(status, json.dumps(value).encode())


class Zenodo(Server):
    """Depositions: a draft, its metadata, and a bucket without folders."""

    def answer(self, path: str, body: bytes) -> None:
        host, api = self.received, "/api/deposit/depositions"
        if self.command == "GET" and path == api:
            self.send_json([host.draft] if host.draft else [])
        elif self.command == "POST" and path == api:
            here = f"http://{self.headers['Host']}"
            doi = {"doi": "10.5281/zenodo.7", "recid": 7}
            metadata = json.loads(body)["metadata"] | {"prereserve_doi": doi}
            host.draft = {"id": 7, "links": {"bucket": f"{here}/api/files/b-7"}, "metadata": metadata, "files": []}
            self.send_json(host.draft, 201)
        elif self.command == "PUT" and path == f"{api}/7" and host.draft:
            host.draft["metadata"] = json.loads(body)["metadata"] | {"prereserve_doi": {"doi": "10.5281/zenodo.7"}}
            self.send_json(host.draft)
        elif self.command == "PUT" and path.startswith("/api/files/b-7/") and path.count("/") == 4 and host.draft:
            name = path.rpartition("/")[2]
            checksum = hashlib.md5(self.store(name, body)).hexdigest()
            others = [f for f in host.draft["files"] if f["filename"] != name]
            host.draft["files"] = [*others, {"id": f"f-{name}", "filename": name, "checksum": checksum}]
            self.send_json({"key": name, "checksum": f"md5:{checksum}", "size": len(body)}, 201)
        elif self.command == "DELETE" and path.startswith(f"{api}/7/files/f-") and host.draft:
            name = path.rpartition("/f-")[2]
            del host.files[name]
            host.draft["files"] = [f for f in host.draft["files"] if f["filename"] != name]
            self._send(204)
        else:
            self.send_json({"message": "no such thing"}, 404)


class Hub(Server):
    """A dataset repository: small files in the commit, tars by git-lfs."""

    def allowed(self) -> bool:
        return self.path.startswith("/lfs/") or super().allowed()  # an upload address is signed

    def answer(self, path: str, body: bytes) -> None:
        files = self.received.files
        if path == "/api/repos/create":
            self.send_json({"url": f"http://{self.headers['Host']}/datasets/owner/name", "id": "owner/name"})
        elif path == "/api/datasets/owner/name/tree/main":
            self.send_json([{"type": "file", "path": p, "size": len(f), "oid": "0"} for p, f in files.items()])
        elif path == "/api/validate-yaml":
            self.send_json({"errors": [], "warnings": []})
        elif path.endswith("/preupload/main"):
            asked = json.loads(body)["files"]
            modes = [
                {"path": f["path"], "uploadMode": "lfs" if f["path"].endswith(".tar") else "regular"} for f in asked
            ]
            self.send_json({"files": [m | {"shouldIgnore": False, "oid": None} for m in modes]})
        elif path.endswith("/info/lfs/objects/batch"):
            here = f"http://{self.headers['Host']}"
            objects = [
                {**o, "authenticated": True, "actions": {"upload": {"href": f"{here}/lfs/{o['oid']}", "header": {}}}}
                for o in json.loads(body)["objects"]
            ]
            self.send_json({"transfer": "basic", "objects": objects})
        elif self.command == "PUT" and path.startswith("/lfs/"):
            self.store(path.removeprefix("/lfs/"), body)
            self._send(200)
        elif path.endswith("/commit/main"):
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "deletedFile":
                    del files[line["value"]["path"]]
                elif line["key"] == "file":
                    files[line["value"]["path"]] = base64.b64decode(line["value"]["content"])
                elif line["key"] == "lfsFile":
                    files[line["value"]["path"]] = files.pop(line["value"]["oid"])
            commit = {"commitUrl": "http://127.0.0.1/owner/name/commit/1", "commitOid": "1", "pullRequestUrl": None}
            self.send_json(commit | {"success": True})
        else:
            self.send_json({"error": "no such thing"}, 404)
