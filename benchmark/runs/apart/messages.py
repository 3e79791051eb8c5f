"""What a caller and the process that fits for it tell each other, over two pipes.

The caller sends objects, each pickled after its length. It gets lines of JSON back, and nothing of them is unpickled:
whoever wrote the method writes them too.
"""

from __future__ import annotations

import json
import os
import pickle
import stat
import struct
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_bytes
from spike4dgs.benchmark.json_values.text import parse_json
from spike4dgs.benchmark.method import GROUP, Budget, Method, find_methods, get_method
from spike4dgs.benchmark.plugins import is_distributed
from spike4dgs.benchmark.runs.method_code import code_of
from spike4dgs.benchmark.runs.predictions import MOST_OF_IMAGE
from spike4dgs.benchmark.runs.provenance import Provenance
from spike4dgs.benchmark.runs.refinement import View
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.untrusted import number

PROGRESS, NOTE, RENDERED, DONE, FAILED = "progress", "note", "rendered", "done", "failed"  # the kinds of lines
COSTS = ("fit_seconds", "render_fps", "peak_memory_mb", "model_mb")
MODEL = "model.safetensors"  # in the work folder
MOST = 1 << 20  # bytes of a line
_LENGTH = struct.Struct("<Q")
_PLAIN = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)  # a FIFO does not hold the reader


@dataclass(frozen=True)
class Order:
    """A fit, as it is sent. `revision` and `cameras` are those of the whole scene: equal inputs give equal bits."""

    method: bytes | str  # pickled; str: the installed method of that name
    code: Mapping[str, Any]  # of the method, as the caller has it; see `identity`
    part: Path  # the training part, absolute
    work: Path  # of the checkpoint and for what is made, absolute
    revision: str
    cameras: Mapping[str, Camera]  # calibrated ones, the held-out ones too
    seed: int
    device: str
    budget: Budget


@dataclass(frozen=True)
class Rest:
    """What is sent once the images at the calibrated poses are the caller's: what they must not depend on."""

    provenance: Provenance  # for the model's file
    views: tuple[View, ...]  # to refine held-out cameras by; none for methods that do not


def images_folder(work: Path, variant: int) -> Path:
    """Return the folder for the images of a variant: 0 at the calibrated poses, 1 at refined ones."""
    return work / f"images-{variant}"


def read_image(folder: Path, name: str) -> bytes:
    """Return the bytes of FOLDER/NAME, which the process wrote, and may still change.

    Raises UserError for no plain file, for one of more than MOST_OF_IMAGE bytes, and where the folder or what is below
    it is a link: to what is not its own.
    """
    wrong = problem(folder / name, "an image of a target", "none", "correct the method that rendered it")
    *inner, last = Path(name).parts
    if os.open not in os.supports_dir_fd:  # Windows, where links need a privilege
        paths = [folder, *(folder.joinpath(*inner[: i + 1]) for i in range(len(inner))), folder / name]
        if any(path.is_symlink() for path in paths) or not paths[-1].is_file():
            raise wrong
        return read_bytes(paths[-1], "an image of a target", MOST_OF_IMAGE)
    with ExitStack() as opened:
        try:
            at: int | None = None
            for part in (str(folder), *inner):
                at = os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=at)
                opened.callback(os.close, at)
            file = opened.enter_context(os.fdopen(os.open(last, _PLAIN, dir_fd=at), "rb"))
        except OSError:
            raise wrong from None
        facts = os.fstat(file.fileno())
        if not stat.S_ISREG(facts.st_mode):
            raise wrong
        if facts.st_size > MOST_OF_IMAGE:
            expected = f"an image of a target, {MOST_OF_IMAGE} bytes at most"
            raise problem(folder / name, expected, f"{facts.st_size}", "correct the method that rendered it")
        return file.read()


def identity(method: Method) -> dict[str, Any]:
    """Return what tells a method from another: name, version, parameters and code."""
    version = getattr(method, "version", None)
    return {"name": method.name, "version": version, "params": dict(method.params), "code": code_of(method)}


def packed_method(method: Method) -> bytes | str:
    """Return a method as it travels: by its name where it is of an installed package, or else pickled.

    To pickle it would run its code here, beside the truth. Raises an exception where it can neither be found nor
    pickled.
    """
    if is_distributed(GROUP, method.name.partition("[")[0]) and identity(get_method(method.name)) == identity(method):
        return method.name
    try:
        return pickle.dumps(method)
    except Exception:  # what pickle raises depends on the object
        installed = find_methods().get(method.name.partition("[")[0])
        if installed is method or installed is not None and get_method(method.name).params == method.params:
            return method.name
        raise


def unpacked_method(packed: bytes | str) -> Method:
    """Return the method that was packed. Raises an exception where its package is not here."""
    method: Method = get_method(packed) if isinstance(packed, str) else pickle.loads(packed)
    return method


def send(pipe: IO[bytes], value: Any) -> None:
    """Send an object."""
    data = pickle.dumps(value)
    pipe.write(_LENGTH.pack(len(data)) + data)
    pipe.flush()


def receive(descriptor: int) -> Any:
    """Return the next object. Raises EOFError where the sender is gone."""
    (length,) = _LENGTH.unpack(_exactly(descriptor, _LENGTH.size))
    return pickle.loads(_exactly(descriptor, length))


def _exactly(descriptor: int, length: int) -> bytes:
    data = bytearray()
    while len(data) < length:
        if not (more := os.read(descriptor, min(length - len(data), MOST))):
            raise EOFError
        data += more
    return bytes(data)


def line_of(kind: str, value: Any) -> bytes:
    """Return a line: its kind and a JSON value."""
    return json.dumps([kind, value]).encode() + b"\n"


def parse_line(line: bytes, where: str) -> tuple[str, Any]:
    """Return the kind and the value of a line. Raises UserError for one that is none."""
    try:
        kind, value = parse_json(line.decode())
        return str(kind), value
    except (ValueError, TypeError) as e:
        fix = "correct the method: nothing else writes to the pipe"
        raise problem(where, "a line of JSON from the fit's process", f"{type(e).__name__}: {e}", fix) from None


def read_costs(value: Any, where: str) -> dict[str, float | None]:
    """Return the costs that a line has: numbers from 0 up, or None. Raises UserError for anything else."""
    try:
        number(value["fit_seconds"], 0.0, 1e12)
        return {cost: None if value[cost] is None else number(value[cost], 0.0, 1e12) for cost in COSTS}
    except (KeyError, TypeError, ValueError) as e:
        raise problem(where, f"numbers for {', '.join(COSTS)}", repr(e), "correct the method") from None
