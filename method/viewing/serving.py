"""Where the viewer is served, and to whom: a free port, and pages of its own origin alone.

A browser lets any page on the web open a WebSocket to this machine. It says in the header Origin which page asks, so
the server compares that with the host that the request goes to.
"""

from __future__ import annotations

import http
import inspect
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from spike4dgs.benchmark.errors import problem

_TRIES = 1000  # ports from the given one up
_LOOPBACK = ("localhost", "127.0.0.1", "::1")


def free_port(host: str, port: int) -> int:
    """Return the first free port from `port` up.

    Raises UserError for a port that is none, a host that is no address of this machine, and where all are taken.
    """
    if not 1 <= port <= 65535:
        raise problem("--port", "a port, 1 to 65535", str(port), "choose another")
    try:
        family, kind, *_, address = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0]
        _try(family, kind, (address[0], 0, *address[2:]))
    except (OSError, UnicodeError) as e:
        found = f"{host[:80]!r} ({getattr(e, 'strerror', None) or e})"
        raise problem("--host", "an address of this machine", found, "0.0.0.0 admits other machines") from None
    for tried in range(port, min(port + _TRIES, 65536)):
        try:
            _try(family, kind, (address[0], tried, *address[2:]))
        except OSError:
            continue
        return tried
    raise problem("--port", f"a free port from {port} up", "none", "choose another")


def _try(family: int, kind: int, address: Any) -> None:
    with socket.socket(family, kind) as tried:
        tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        tried.bind(address)


def is_own(origin: str | None, asked: str | None, host: str) -> bool:
    """Return whether a request may come from a page of the server that serves at `host`.

    `origin` and `asked` are its headers Origin and Host; programs send no origin. On this machine alone the name has
    to be one of this machine's, since other names may be made to point at it.

    >>> is_own("http://localhost:8080", "localhost:8080", "127.0.0.1")
    True
    >>> is_own("https://a.example", "localhost:8080", "127.0.0.1")
    False
    """
    try:
        named, page = urlsplit(f"//{asked or ''}"), urlsplit(origin or "")
    except ValueError:  # such as "[::1", half an address
        return False
    if host in _LOOPBACK and named.hostname not in _LOOPBACK:
        return False
    return origin is None or page.netloc.lower() == named.netloc.lower()


def url_of(host: str, port: int) -> str:
    """Return the address of a server for a browser of this machine.

    >>> url_of("0.0.0.0", 8080), url_of("::1", 8080)
    ('http://localhost:8080', 'http://[::1]:8080')
    """
    if host in ("127.0.0.1", "0.0.0.0", "::"):
        host = "localhost"
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


@contextmanager
def own_origins(host: str) -> Iterator[None]:
    """Servers of viser that start meanwhile refuse requests of other pages: it has no option for that."""
    from websockets.asyncio import server

    original = server.serve

    def serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        async def checked(connection: Any, request: Any) -> Any:
            if not is_own(request.headers.get("Origin"), request.headers.get("Host"), host):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "another page's request\n")
            answer = process_request(connection, request) if process_request else None
            return await answer if inspect.isawaitable(answer) else answer

        return original(*arguments, process_request=checked, **options)

    server.serve = serve  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        server.serve = original  # type: ignore[misc]
