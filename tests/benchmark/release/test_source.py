"""Answers that would take all memory: bodies without an end, and some that unpack to more than they have bytes."""

import gzip
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
from range_server import Handler, serve

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.release import source
from spike4dgs.benchmark.release.source import Source

pytest.importorskip("aiohttp", reason="aiohttp is not installed (extra: download)")
MOST = 4 << 20


class Endless(Handler):
    """Sends on and on, whatever is asked."""

    def _answer(self, with_body: bool) -> None:
        self.send_response(206 if self.headers.get("Range") else 200)
        self.send_header("Content-Range", "bytes 100-199/1000")
        self.send_header("Connection", "close")
        self.end_headers()
        self.close_connection = True
        try:
            while with_body:
                self.wfile.write(bytes(1 << 16))
        except OSError:  # the client is gone
            pass


class Bomb(Handler):
    """Sends a gigabyte of zeros, packed, though it was asked for bytes as they are."""

    def _answer(self, with_body: bool) -> None:
        assert self.headers["Accept-Encoding"] == "identity"
        packed = gzip.compress(bytes(1 << 24), 9) * 64  # a gzip file may have several members
        self.send_response(200)
        self.send_header("Content-Encoding", "gzip")
        self.send_header("Content-Length", str(len(packed)))
        self.end_headers()
        if with_body:
            self.wfile.write(packed)


READS: dict[str, Callable[[Source], bytes]] = {
    "whole": lambda s: s.read_all("index.json"),
    "part": lambda s: s.persist(lambda: s.read("shard.tar", 100, 200, 1000), "shard.tar"),
}


@pytest.mark.parametrize("read", READS)
def test_a_body_without_an_end_is_an_error(tmp_path: Path, read: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source, "MOST_BODY", MOST)
    with serve(tmp_path, handler=Endless) as (address, _):
        tracemalloc.start()
        try:
            with pytest.raises(UserError, match="expected an answer, found TooMuch an answer of more than 4 MiB"):
                READS[read](Source(address))
            assert tracemalloc.get_traced_memory()[1] < 8 * MOST
        finally:
            tracemalloc.stop()


def test_a_file_that_is_too_large_is_not_read_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source, "MOST_BODY", 1 << 20)
    for size, refused in ((1 << 20, False), (1 << 30, True)):
        with open(tmp_path / "index.json", "wb") as file:
            file.truncate(size)
        tracemalloc.start()
        try:
            if refused:
                with pytest.raises(UserError, match="an answer of more than 1 MiB"):
                    Source(str(tmp_path)).read_all("index.json")
            else:
                assert len(Source(str(tmp_path)).read_all("index.json")) == size
            assert tracemalloc.get_traced_memory()[1] < 8 << 20
        finally:
            tracemalloc.stop()


def test_packed_bytes_stay_packed(tmp_path: Path) -> None:
    with serve(tmp_path, handler=Bomb) as (address, _):
        data = Source(address).read_all("index.json")
    assert data[:2] == b"\x1f\x8b" and len(data) < 4 << 20
