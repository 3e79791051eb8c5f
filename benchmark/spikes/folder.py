"""A folder of recorded streams without poses, `stream.json` beside `.dat` files: a recording before calibration.

stream.json (schema `spike4dgs-streams/1`) states what the headerless files cannot: size, rate, order of rows, ticks.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_json, write_json
from spike4dgs.benchmark.spikes.gaps import read_gaps, refuse_gaps
from spike4dgs.benchmark.spikes.sensor_model import MOST_DEAD_TICKS
from spike4dgs.benchmark.spikes.stream import SpikeStream, open_stream
from spike4dgs.benchmark.untrusted import MAX_HZ, MAX_SIDE, MAX_TICKS, check_ids, inside, number, positive, whole

NAME = "stream.json"
_SCHEMA = "spike4dgs-streams/1"


def write_stream_folder(root: Path, streams: Mapping[str, SpikeStream], facts: Mapping[str, Any] | None = None) -> None:
    """Describe streams, which are already in `root` as `CAMERA.dat`, in stream.json.

    `facts` are what else is known of the recording: clock, sync, source.
    """
    described = {
        camera: {
            "file": f"{camera}.dat",
            "width": s.width,
            "height": s.height,
            "rate_hz": s.rate_hz,
            "rows_bottom_up": s.rows_bottom_up,
            "n_ticks": s.n_ticks,
            **({"dead_ticks": s.dead_ticks} if s.dead_ticks else {}),
        }
        for camera, s in streams.items()
    }
    gaps = [gap.record for s in streams.values() for gap in s.gaps]
    write_json(root / NAME, {"schema": _SCHEMA, "streams": described, "gaps": gaps, **(facts or {})})


def open_stream_folder(root: Path, allow_gaps: bool = False) -> dict[str, SpikeStream]:
    """Memory-map every stream of a folder, by camera.

    Raises UserError where stream.json or a stream is missing, damaged, truncated or of another format, and where the
    recording has gaps unless `allow_gaps`.
    """
    path = root / NAME
    data = read_json(path, "a description of streams")
    if data.get("schema") != _SCHEMA:
        raise problem(path, f"schema '{_SCHEMA}'", f"{data.get('schema')!r}", "import the recording again")
    streams = {}
    try:
        described = {str(camera): dict(s) for camera, s in data["streams"].items()}
        check_ids(described, "camera", path)
        ticks = {camera: whole(s["n_ticks"], 1, MAX_TICKS) for camera, s in described.items()}
        gaps = read_gaps(data.get("gaps", []), ticks, path)
        for camera, s in described.items():
            width, height = (whole(s[key], 1, MAX_SIDE) for key in ("width", "height"))
            own, order = tuple(gap for gap in gaps if gap.camera == camera), bool(s["rows_bottom_up"])
            file, rate_hz = inside(root, str(s["file"]), path), positive(s["rate_hz"], MAX_HZ)
            dead = number(s.get("dead_ticks", 0), 0, MOST_DEAD_TICKS)
            streams[camera] = open_stream(
                file, width, height, rate_hz, rows_bottom_up=order, n_ticks=ticks[camera], gaps=own, dead_ticks=dead
            )
    except (KeyError, TypeError, ValueError, AttributeError) as e:
        raise problem(path, "file, width, height, rate_hz, ... of streams", repr(e), "import it again") from None
    refuse_gaps(gaps, path, allow_gaps)
    return streams
