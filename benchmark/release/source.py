"""The folder that a release or weights are fetched from, through fsspec: https://, hf://, s3://, file://, a path, ...

A read is one request for a range of bytes. Reads that fail are tried again, after waits that double; what will not
change, such as a file that is not there, fails at once.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from threading import Event, Lock
from typing import Any, TypeVar

from rich.console import Console

from spike4dgs.benchmark.errors import UserError, problem

_LINE_EVERY_S = 20.0


def size_text(n_bytes: float) -> str:
    """Return a size for people, in decimal units.

    >>> size_text(1_234_567)
    '1.2 MB'
    """
    for unit in ("B", "kB", "MB", "GB"):
        if n_bytes < 1000:
            return f"{n_bytes:.0f} {unit}" if unit == "B" else f"{n_bytes:.1f} {unit}"
        n_bytes /= 1000
    return f"{n_bytes:.1f} TB"


class ByteProgress:
    """Bytes done of a known number, with the rate and an estimate of the time left. Threads may share it."""

    def __init__(self, title: str, total: int) -> None:
        from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn
        from rich.progress import TimeRemainingColumn as Left

        self.title, self.total, self.done, self.skipped = title, total, 0, 0
        self._console = Console(stderr=True, highlight=False)
        columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
        self._bars = Progress(
            *columns, TextColumn("left"), Left(), console=self._console, disable=not self._console.is_terminal
        )
        self._task = self._bars.add_task(title, total=total)
        self._lock = Lock()

    def __enter__(self) -> ByteProgress:
        self._bars.start()
        self.started = self._said = time.monotonic()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds = time.monotonic() - self.started
        self._bars.stop()

    def advance(self, n_bytes: int) -> None:
        """Count bytes that were just done."""
        with self._lock:
            self.done += n_bytes
            self._bars.advance(self._task, n_bytes)
            now = time.monotonic()
            if not self._console.is_terminal and now - self._said >= _LINE_EVERY_S:
                self._said = now
                rate = (self.done - self.skipped) / (now - self.started)
                left = f", about {(self.total - self.done) / rate:.0f} s left" if rate > 0 else ""
                rest = f"{size_text(self.done)} of {size_text(self.total)}, {size_text(rate)}/s{left}"
                self._console.print(f"{self.title}: {rest}", markup=False)

    def skip(self, n_bytes: int) -> None:
        """Count bytes that an earlier run did."""
        with self._lock:
            self.done += n_bytes
            self.skipped += n_bytes
            self._bars.advance(self._task, n_bytes)


VARIABLE = "SPIKE4DGS_RELEASE"
_T = TypeVar("_T")


@dataclass(frozen=True)
class Patience:
    """How failed reads are tried again."""

    tries: int = 8  # in a row without one good read; the waits between them add up to a minute
    first_wait_s: float = 0.5
    longest_wait_s: float = 30.0


class Stopped(Exception):
    """Raised in a thread that works for a download that has failed elsewhere."""


class Source:
    """A folder behind an address. Threads may share it; `stop` ends their waits."""

    def __init__(self, address: str, patience: Patience = Patience()) -> None:
        """Raises UserError where the address is of a kind that this machine cannot read."""
        self.address, self.patience, self.stop, self.requests = address.rstrip("/"), patience, Event(), 0
        self._lock = Lock()
        try:
            from fsspec.core import url_to_fs

            self._fs, root = url_to_fs(address, **_options(address))
        except ImportError as e:
            found, fix = str(e).partition("\n")[0], "pip install 'spike4dgs[download]'"
            raise problem(address, "an address that the installed packages can read", found, fix) from None
        except ValueError as e:
            fix = "give https://..., hf://datasets/OWNER/NAME, file:///FOLDER or a path"
            raise problem(address, "an address", str(e), fix) from None
        self._root = root.rstrip("/")

    def where(self, name: str) -> str:
        """Return the address of a file, for messages."""
        return f"{self.address}/{name}"

    def read(self, name: str, start: int, stop: int, size: int) -> bytes:
        """Return the bytes [start, stop) of a file of `size` bytes: one request, not tried again."""
        self._count()
        with self._fs.open(f"{self._root}/{name}", "rb", cache_type="none", size=size) as file:
            file.seek(start)
            data = bytes(file.read(stop - start))
        if len(data) != stop - start:
            raise EOFError(f"{len(data)} of {stop - start} bytes")
        return data

    def read_all(self, name: str) -> bytes:
        """Return a small file. Raises UserError where it cannot be read, or has more than MOST_BODY bytes."""
        # Answers over http are bounded already, and not all servers send a part of a file.
        end = None if self.address.startswith(_HTTP) else MOST_BODY + 1

        def read() -> bytes:
            self._count()
            data = bytes(self._fs.cat_file(f"{self._root}/{name}", end=end))
            if len(data) > MOST_BODY:
                raise TooMuch(f"an answer of more than {MOST_BODY >> 20} MiB")
            return data

        return self.persist(read, name)

    def _count(self) -> None:
        with self._lock:
            self.requests += 1

    def size(self, name: str) -> int | None:
        """Return the size of a file, if the server tells. Raises UserError where there is no such file."""
        size = self.persist(lambda: self._fs.info(f"{self._root}/{name}").get("size"), name)
        return None if size is None else int(size)

    def persist(self, read: Callable[[], _T], name: str) -> _T:
        """Return what `read` returns, tried again where it fails. Raises UserError where it keeps failing."""
        failures = 0
        while True:
            try:
                return read()
            except Exception as e:  # file systems behind fsspec raise errors of their own kinds
                failures += 1
                self.wait(e, failures, name)

    def wait(self, error: Exception, failures: int, name: str) -> None:
        """Wait before a read is tried again. Raises UserError after too many failures, or one that will not change."""
        if isinstance(error, UserError):
            raise error
        if isinstance(error, ValueError) and "range requests" in str(error):
            fix = "use another server, or copy the release to this machine and name its folder"
            raise problem(self.where(name), "a server that sends parts of a file", "one that does not", fix) from None
        if isinstance(error, FileNotFoundError):
            fix = "check the address, and that the server has the whole folder"
            raise problem(self.where(name), "a file", "no such file", fix) from None
        text = " ".join(f"{type(error).__name__} {error}".split())[:200]
        if _lasts(error):
            raise problem(self.where(name), "an answer", text, "check the address and the access to it") from None
        if failures >= self.patience.tries:
            fix = "check the connection, then run the same command again: it goes on where it stopped"
            raise problem(self.where(name), "an answer", f"{text}, {failures} times in a row", fix) from None
        wait_s = min(self.patience.first_wait_s * 2.0 ** (failures - 1), self.patience.longest_wait_s)
        if self.stop.wait(wait_s):
            raise Stopped


def find_source(address: str | None, what: str, made: str = "make-dataset") -> Source:
    """Return the source at an address, or at the one that SPIKE4DGS_RELEASE names. Raises UserError without either."""
    chosen = address or os.environ.get(VARIABLE)
    if not chosen:
        fix = f"there is no public server yet: add --from ADDRESS, set {VARIABLE}, or render with `{made}`"
        raise problem("--from", f"the address of {what}", "none", fix)
    return Source(chosen)


def _options(address: str) -> dict[str, Any]:
    if not address.startswith(_HTTP):
        return {}
    from aiohttp import ClientTimeout

    # A slow connection is none that is cut: only silence counts. Proxies are taken from the environment.
    client = {
        "timeout": ClientTimeout(total=None, sock_connect=30, sock_read=60),
        "trust_env": True,
        "auto_decompress": False,  # a body of some kB can unpack to more than the memory holds
        "response_class": _bounded_response(),
    }
    return {"headers": {"Accept-Encoding": "identity"}, "client_kwargs": client}


_HTTP = ("http://", "https://")
MOST_BODY = 64 << 20  # bytes of an answer: a piece of a release has 16 MiB, an index some MB
_BLOCK = 1 << 16


class TooMuch(Exception):
    """Raised for an answer of more than MOST_BODY bytes."""


@cache
def _bounded_response() -> type:
    from aiohttp import ClientResponse

    class Bounded(ClientResponse):
        """An answer that is read whole only as far as MOST_BODY bytes: a server may never stop sending."""

        async def read(self) -> bytes:
            """Raises TooMuch for more."""
            if self._body is None:
                parts, size = [], 0
                while part := await self.content.read(_BLOCK):
                    parts.append(part)
                    if (size := size + len(part)) > MOST_BODY:
                        self.close()
                        raise TooMuch(f"an answer of more than {MOST_BODY >> 20} MiB")
                self._body = b"".join(parts)
            return await super().read()

    return Bounded


def _lasts(error: Exception) -> bool:
    """Return True for an error that trying again does not mend."""
    status = getattr(error, "status", None) or getattr(getattr(error, "response", None), "status_code", None)
    if isinstance(status, int):
        return 400 <= status < 500 and status not in (408, 425, 429)  # timeout, too early, too many requests
    return isinstance(
        error, TooMuch | PermissionError | NotADirectoryError | IsADirectoryError | ImportError | ValueError
    )
