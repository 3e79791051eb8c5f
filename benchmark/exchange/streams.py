"""Open what people have of a recording: a bare `.dat` file, a folder of streams, or a scene folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.benchmark.spikes.folder import NAME as STREAM_FOLDER
from spike4dgs.benchmark.spikes.folder import open_stream_folder
from spike4dgs.benchmark.spikes.image_size import ALIKE, fitting_sizes, row_agreement
from spike4dgs.benchmark.spikes.stream import SpikeStream, bytes_per_tick, open_stream
from spike4dgs.benchmark.untrusted import MAX_HZ, MAX_SIDE


@dataclass(frozen=True)
class DatFile:
    """Facts that a headerless .dat file does not state.

    Args:
        width: Pixels per row of a .dat file.
        height: Rows of a .dat file.
        rate_hz: Ticks per second of a .dat file.
        rows_top_down: The first row of a .dat file is the top one (these cameras usually store the bottom row first).
    """

    width: int | None = None
    height: int | None = None
    rate_hz: float | None = None
    rows_top_down: bool = False

    def options(self) -> dict[str, float | None]:
        """Return size and rate by the names of their options."""
        return {"--width": self.width, "--height": self.height, "--rate-hz": self.rate_hz}


DAT_FILE = DatFile()


def open_streams(path: Path, dat_file: DatFile = DAT_FILE, allow_gaps: bool = False) -> dict[str, SpikeStream] | Scene:
    """Return a scene, or the streams by camera of a folder of streams or a .dat file, which is called like its file.

    Raises UserError for facts of a file beside a folder, which states its own, and where a .dat file lacks size or
    rate; the error then says which sizes fit the file.
    """
    if path.is_dir():
        facts = dat_file.options() | {"--rows-top-down": dat_file.rows_top_down or None}
        if given := [name for name, value in facts.items() if value is not None]:
            expected = "nothing for a folder, which states its own size"
            raise problem(", ".join(given), expected, "values", "leave them out")
        is_streams = (path / STREAM_FOLDER).is_file()
        return open_stream_folder(path, allow_gaps) if is_streams else open_scene(path, allow_gaps)
    if not path.exists():
        raise problem(path, "a stream file or a scene folder", "no such file", "check the path")
    width, height, rate_hz = dat_file.width, dat_file.height, dat_file.rate_hz
    if width is None or height is None or rate_hz is None:
        missing = ", ".join(name for name, value in dat_file.options().items() if value is None)
        expected = "--width, --height and --rate-hz for a headerless stream"
        raise problem(path, expected, f"no {missing}", "state the camera's" + _proposal(path, width, height))
    if not 0 < rate_hz <= MAX_HZ:
        raise problem("--rate-hz", f"a positive rate, {MAX_HZ:g} at most", f"{rate_hz:g}", "state the camera's")
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise problem("--width and --height", f"1 to {MAX_SIDE}", f"{width}, {height}", "state the camera's")
    size, found = bytes_per_tick(width, height), path.stat().st_size
    if found % size:
        fix = "the stream is truncated, or width and height are wrong" + _proposal(path)
        raise problem(path, f"whole ticks of {size} bytes ({width}x{height})", f"{found} bytes", fix)
    return {path.stem: open_stream(path, width, height, rate_hz, rows_bottom_up=not dat_file.rows_top_down)}


def _proposal(path: Path, width: int | None = None, height: int | None = None) -> str:
    """Return the known sizes that a file's length fits, as the end of a message; nothing where the size is given."""
    if (width is not None and height is not None) or not path.is_file() or path.stat().st_size == 0:
        return ""
    data = np.memmap(path, np.uint8, "r")
    if not (sizes := fitting_sizes(data)):
        return "; its length fits no size that we know"
    best = sizes[0]
    rows = f", its rows {best[0]}x{best[1]} best" if len(sizes) > 1 and row_agreement(data, best) > ALIKE else ""
    return f"; its length fits {', '.join(f'{w}x{h}' for w, h in sizes)}{rows}"
