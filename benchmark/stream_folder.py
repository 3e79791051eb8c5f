"""A folder of recorded streams without poses, `stream.json` beside `.dat` files: a recording before calibration.

stream.json (schema `spike4dgs-streams/1`) states what the headerless files cannot: size, rate, order of rows, ticks.
"""

from __future__ import annotations

from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_json, write_json
from spike4dgs.benchmark.spikes import SpikeStream, open_stream

NAME = "stream.json"
_SCHEMA = "spike4dgs-streams/1"


def write_stream_folder(root: Path, streams: dict[str, SpikeStream]) -> None:
    """Describe streams, which are already in `root` as `CAMERA.dat`, in stream.json."""
    described = {
        camera: {
            "file": f"{camera}.dat",
            "width": s.width,
            "height": s.height,
            "rate_hz": s.rate_hz,
            "rows_bottom_up": s.rows_bottom_up,
            "n_ticks": s.n_ticks,
        }
        for camera, s in streams.items()
    }
    write_json(root / NAME, {"schema": _SCHEMA, "streams": described})


def open_stream_folder(root: Path) -> dict[str, SpikeStream]:
    """Memory-map every stream of a folder, by camera.

    Raises UserError where stream.json or a stream is missing, damaged, truncated or of another format.
    """
    path = root / NAME
    data = read_json(path, "a description of streams")
    if data.get("schema") != _SCHEMA:
        raise problem(path, f"schema '{_SCHEMA}'", f"{data.get('schema')!r}", "import the recording again")
    streams = {}
    try:
        for camera, s in data["streams"].items():
            order, n_ticks = bool(s["rows_bottom_up"]), int(s["n_ticks"])
            size = (int(s["width"]), int(s["height"]))
            streams[str(camera)] = open_stream(
                root / str(s["file"]), *size, float(s["rate_hz"]), rows_bottom_up=order, n_ticks=n_ticks
            )
    except (KeyError, TypeError, ValueError, AttributeError) as e:
        raise problem(path, "file, width, height, rate_hz, ... of streams", repr(e), "import it again") from None
    return streams
