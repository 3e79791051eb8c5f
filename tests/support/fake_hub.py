"""A server that answers as Hugging Face's hub does, for one dataset repository that is a folder here."""

import json
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from range_server import Behaviour, Handler, serve

REPOSITORY = "owner/name"
_FILES, _TREE = "/resolve/main/", f"/api/datasets/{REPOSITORY}/tree/main"


def serve_hub(root: Path) -> AbstractContextManager[tuple[str, Behaviour]]:
    """Serve the folder as the repository REPOSITORY; give the endpoint and the behaviour with its requests."""
    return serve(root, handler=_Hub)


class _Hub(Handler):
    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if _FILES in path:
            self.path = f"/{path.partition(_FILES)[2]}"
            super().do_GET()
        elif path.startswith(_TREE):
            inside = unquote(path.removeprefix(_TREE)).strip("/")
            self._json([self._entry(p) for p in sorted((self.folder / inside).iterdir())])
        else:
            self._json({"id": REPOSITORY, "sha": "a" * 40, "siblings": [], "tags": []})

    def _entry(self, path: Path) -> dict[str, Any]:
        kind = {"type": "file", "size": path.stat().st_size} if path.is_file() else {"type": "directory"}
        return {"path": path.relative_to(self.folder).as_posix(), "oid": "b" * 40, **kind}

    def _json(self, value: Any) -> None:
        data = json.dumps(value).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)
