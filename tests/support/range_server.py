"""An HTTP server of a folder that answers range requests, and misbehaves as it is told."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from threading import Lock
from typing import Any
from urllib.parse import unquote

from local_server import running


@dataclass
class Behaviour:
    """What the server does wrong, and the requests that it got. Faults concern the files with this suffix alone."""

    suffix: str = ".tar"
    ranges: bool = True
    cut_after: int | None = None  # bytes of an answer after which the connection is cut,
    cuts: int = 0  # this many times
    flips: int = 0  # answers in which a bit is wrong
    flip_at: int | None = None  # a byte of the file that is wrong in every answer
    failures: list[int] = field(default_factory=list)  # statuses of the next answers
    pause_s: float = 0.0  # before each 64 KiB
    requests: list[tuple[str, str | None]] = field(default_factory=list)  # path and Range header
    lock: Any = field(default_factory=Lock)

    def asked(self, suffix: str = ".tar") -> list[str | None]:
        """The ranges of the requests for files with a suffix."""
        return [asked for path, asked in self.requests if path.endswith(suffix)]


@contextmanager
def serve(
    root: Path, behaviour: Behaviour | None = None, handler: type[Handler] | None = None
) -> Iterator[tuple[str, Behaviour]]:
    """Serve a folder on a free port of this machine; yield its address and the behaviour, which may be changed."""
    chosen, kind = behaviour or Behaviour(), handler or Handler

    class OfThisFolder(kind):  # type: ignore[misc, valid-type]
        folder, behaviour = root, chosen

    with running(OfThisFolder) as address:
        yield address, chosen


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    folder: Path
    behaviour: Behaviour

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def _answer(self, with_body: bool) -> None:
        b, asked = self.behaviour, self.headers.get("Range")
        name = unquote(self.path)
        path = self.folder / name.lstrip("/")
        faulty = name.endswith(b.suffix) and with_body
        with b.lock:
            if with_body:
                b.requests.append((name, asked))
            status = b.failures.pop(0) if faulty and b.failures else None
            cut = faulty and b.cuts > 0
            flip = faulty and b.flips > 0
            b.cuts -= cut
            b.flips -= flip
        if status or not path.is_file():
            self.send_response(status or 404)
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        size = path.stat().st_size
        start, stop = 0, size
        if asked and b.ranges:
            found = re.fullmatch(r"bytes=(\d+)-(\d+)", asked)
            assert found, asked
            start, stop = int(found[1]), min(int(found[2]) + 1, size)
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{size}")
        else:
            self.send_response(200)
        self.send_header("Content-Length", str(stop - start))
        self.end_headers()
        if not with_body:
            return
        with open(path, "rb") as file:
            file.seek(start)
            data = bytearray(file.read(stop - start))
        if flip:
            data[len(data) // 2] ^= 1
        if faulty and b.flip_at is not None and start <= b.flip_at < stop:
            data[b.flip_at - start] ^= 1
        if cut and b.cut_after is not None:
            data = data[: b.cut_after]
        try:
            for position in range(0, len(data), 1 << 16):
                if b.pause_s:
                    time.sleep(b.pause_s)
                self.wfile.write(data[position : position + (1 << 16)])
            self.wfile.flush()
        except OSError:  # the client is gone
            self.close_connection = True
        if cut:
            self.close_connection = True
