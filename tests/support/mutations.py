"""Hostile versions of a file's bytes: damaged anywhere, or well formed with values that nobody should believe."""

import json
import struct
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

Rng = np.random.Generator
Mutation = Callable[[bytes, Rng], bytes]


class Raw(str):
    """JSON text that stands for itself."""


LONG = "9" * 400
VALUES: tuple[Any, ...] = (
    *map(Raw, (LONG, f"-{LONG}", *"1e400 -1e400 1e308 -1e308 NaN Infinity 1e-320 18446744073709551616".split())),
    *map(Raw, ('"\\ud800"', '"\\u0000"', "[" * 3000 + "]" * 3000, '{"a":' * 200 + "1" + "}" * 200)),
    *("", *". .. ../x ../../x /etc/passwd a/../../b a\\b C:x CAM_00 ñ".split(), "x" * 5000, "a\nb", "-o", "nan"),
    *(0, -1, 1, 1.5, 2**31, 2**53 + 1, 2**63 - 1, 16384, 65536, 10**12, 1e9, -0.0, True, False, None),
    *([], {}, [[]], {"a": {"b": []}}, [1, 2, 3], [None] * 50, ["a"] * 3),
)


def pick(rng: Rng, items: Any) -> Any:
    return items[int(rng.integers(len(items)))]


# ---------------------------------------------------------------- any bytes


def flip(data: bytes, rng: Rng) -> bytes:
    """Some bytes are others, most of them near the start, where headers are."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        end = len(out) if rng.random() < 0.5 else min(len(out), 400)
        if end:
            out[int(rng.integers(end))] = int(pick(rng, (0, 255, 128, 127, int(rng.integers(256)))))
    return bytes(out)


def integers(data: bytes, rng: Rng) -> bytes:
    """A field of 2, 4 or 8 bytes holds an extreme number."""
    out, size = bytearray(data), int(pick(rng, (2, 4, 8)))
    if len(out) > size:
        at = int(rng.integers(min(len(out) - size, 400)))
        value = pick(rng, (0, 1, -1, 2 ** (8 * size - 1) - 1, -(2 ** (8 * size - 1)), 36000, 2**14))
        out[at : at + size] = (value % 2 ** (8 * size)).to_bytes(size, pick(rng, ("little", "big")))
    return bytes(out)


def cut(data: bytes, rng: Rng) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def grow(data: bytes, rng: Rng) -> bytes:
    return data + bytes(rng.integers(0, 256, int(rng.integers(1, 5000)), dtype=np.uint8))


def splice(data: bytes, rng: Rng) -> bytes:
    """A part of the file stands at another place too."""
    a, b, at = sorted(int(v) for v in rng.integers(0, len(data) + 1, 3))
    return data[:at] + data[a:b] + data[at:]


def nothing(data: bytes, rng: Rng) -> bytes:
    return b""


BYTES: tuple[Mutation, ...] = (flip, flip, integers, integers, cut, grow, splice, nothing)

# ---------------------------------------------------------------- JSON


def emit(value: Any) -> str:
    """Return JSON text; `Raw` stands for itself, and a list of pairs in a tuple is an object with any keys."""
    if isinstance(value, Raw):
        return str(value)
    if isinstance(value, tuple):
        return "{" + ",".join(f"{json.dumps(k)}:{emit(v)}" for k, v in value) + "}"
    if isinstance(value, dict):
        return emit(tuple(value.items()))
    if isinstance(value, list):
        return "[" + ",".join(map(emit, value)) + "]"
    return json.dumps(value)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    found = [path] if path else []
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in items:
        found += places(child, (*path, key))
    return found


def change(value: Any, rng: Rng) -> Any:
    """Return JSON's value, parsed, with one thing changed: a value, a key, or a key twice."""
    value = json.loads(json.dumps(value))
    every = places(value)
    if not every:
        return pick(rng, VALUES)
    top = [p for p in every if len(p) <= 2]
    *path, key = pick(rng, top if rng.random() < 0.5 else every)
    parent = value
    for step in path:
        parent = parent[step]
    how = rng.random()
    if how < 0.7 or isinstance(parent, list):
        parent[key] = pick(rng, VALUES)
    elif how < 0.8:
        del parent[key]
    elif how < 0.9:
        name = pick(rng, [v for v in VALUES if isinstance(v, str) and not isinstance(v, Raw)])
        parent[name] = parent.pop(key)
    elif not path:
        return (*value.items(), (key, pick(rng, VALUES)))
    else:
        grand = value
        for step in path[:-1]:
            grand = grand[step]
        grand[path[-1]] = (*parent.items(), (key, pick(rng, VALUES)))
    return value


def in_json(data: bytes, rng: Rng) -> bytes:
    value = json.loads(data)
    for _ in range(int(rng.integers(1, 3))):
        if isinstance(value, dict | list):
            value = change(value, rng) if not _has_raw(value) else value
    return emit(value).encode()


def _has_raw(value: Any) -> bool:
    if isinstance(value, dict | list):
        return any(map(_has_raw, value.values() if isinstance(value, dict) else value))
    return isinstance(value, Raw | tuple)


# ---------------------------------------------------------------- other texts


WORDS = (
    *(LONG, *'1e400 nan inf -1 0 ../x "../x" [] {}'.split(), "[" * 2000, "- " * 500, "*a", "&a [*a, *a]", "1e308"),
    *("!!python/object:os.system x", "<<: *a", "'", '"', "\t", "\x00", "\u2028", "true"),
    *("<a>" * 300, "0x" + "f" * 400, "{a: " * 500),
)


def in_text(data: bytes, rng: Rng) -> bytes:
    """A word of a text is another, or a line is gone or stands twice."""
    lines = data.decode("utf-8", "replace").split("\n")
    at = int(rng.integers(len(lines)))
    how = rng.random()
    if how < 0.15:
        del lines[at]
    elif how < 0.3:
        lines.insert(int(rng.integers(len(lines))), lines[at])
    else:
        words = lines[at].split(" ")
        words[int(rng.integers(len(words)))] = str(pick(rng, WORDS))
        lines[at] = " ".join(words)
    return "\n".join(lines).encode("utf-8", "replace")


# ---------------------------------------------------------------- formats


def in_png(data: bytes, rng: Rng) -> bytes:
    """The header states another size or kind, with a checksum that agrees."""
    header = bytearray(data[12:29])  # IHDR, width, height, depth, colour, ...
    if rng.random() < 0.7:
        at = int(pick(rng, (4, 8)))
        header[at : at + 4] = struct.pack(">I", int(pick(rng, (0, 1, 36000, 2**31 - 1, 2**14, 41))))
    else:
        header[int(rng.integers(12, 17))] = int(rng.integers(0, 20))
    return data[:12] + bytes(header) + struct.pack(">I", zlib.crc32(header)) + data[33:]


def in_exr(data: bytes, rng: Rng) -> bytes:
    """The header states another window, type or compression."""
    out = bytearray(data)
    if rng.random() < 0.6 and (at := data.find(b"dataWindow\0box2i\0")) >= 0:
        at += 21 + 4 * int(rng.integers(4))
        out[at : at + 4] = struct.pack("<i", int(pick(rng, (0, -1, 35999, 2**31 - 1, -(2**31), 16383, 40))))
    else:
        out[int(rng.integers(4, min(len(out), 120)))] = int(pick(rng, (0, 1, 2, 3, 4, 9, 255)))
    return bytes(out)


def in_safetensors(data: bytes, rng: Rng) -> bytes:
    """The header, which is JSON, states something else; lengths agree."""
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    changed = emit(change(header, rng)).encode()
    length = len(changed) if rng.random() < 0.9 else int(pick(rng, (0, 2**63, 10**8, 1)))
    return length.to_bytes(8, "little") + changed + data[8 + size :]


def in_npz(data: bytes, rng: Rng) -> bytes:
    """One array's header states another shape or type; the archive is whole."""
    import io
    import zipfile

    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        chosen = pick(rng, old.namelist())
        for name in old.namelist():
            content = old.read(name)
            if name == chosen:
                shape = pick(
                    rng, ("(10**15,)", "(1099511627776,)", "(-1,)", "(2, 2)", "()", "(0,)", "(65536, 65536)", "x")
                )
                kind = pick(rng, ("<i8", "|O", "<f8", "<U9", "|V99999", "<i8", ">c16", "x"))
                text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
                text += b" " * (63 - (10 + len(text)) % 64) + b"\n"
                head = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text
                content = head + (bytes(50_000_000) if rng.random() < 0.05 else content[-400:])
            new.writestr(name, content)
    return out.getvalue()
