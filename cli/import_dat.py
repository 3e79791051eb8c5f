"""`import-dat`: bare `.dat` streams, one for each camera, as a folder of streams or a scene."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import OmitArgPrefixes, Positional

from spike4dgs.benchmark.exchange.dat import import_dat as import_streams
from spike4dgs.benchmark.exchange.recording import Recording
from spike4dgs.cli.options import warn_of_size


def import_dat(
    path: Positional[Path],
    *,
    width: int,
    height: int,
    recording: OmitArgPrefixes[Recording],
    out: Path,
    cameras: Path | None = None,
    row_columns: int | None = None,
) -> int:
    """Import a bare .dat file, or a folder of them (one per camera), as a folder of streams or a scene folder.

    The layout is that of `inspect` and of SpikeCV: no header, 1 bit per pixel, row-major, least significant bit first;
    a tick takes ceil(width * height / 8) bytes. Without --cameras the result is a folder of streams (stream.json), for
    `inspect`, `images`, `calibrate-rig` and `fit`. With --cameras it is a scene whose cameras are all for training.

    Cameras come from a COLMAP model (its folder, text or binary), from OpenCV (a YAML or XML file with a map for each
    camera, or a folder of files, one for each), or from Kalibr (camchain.yaml). Every .dat file needs a camera of the
    same name. Lens distortion by OpenCV's k1, k2, p1, p2, k3 is kept (COLMAP's SIMPLE_RADIAL, RADIAL, OPENCV, and
    FULL_OPENCV without k4 to k6; Kalibr's radtan). Any other lens, such as a fisheye, is refused if it moves a point of
    the image by 0.05 px or more.

    Args:
        path: A .dat file, or a folder of them; each camera has the name of its file.
        width: Pixels per row.
        height: Rows.
        out: New folder to write.
        cameras: COLMAP model folder, OpenCV file or folder, or Kalibr file. COLMAP's unit of length is arbitrary; a
            scene's is the metre.
        row_columns: Columns of a stored row, where it is longer than the image: 416 in raw dumps of the 400x250 camera.
            Those beyond --width are dropped.
    """
    streams = import_streams(
        path, out, width=width, height=height, recording=recording, cameras=cameras, row_columns=row_columns
    )
    warn_of_size(streams)
    for stream in streams.values():
        print(f"{stream.source}: {stream.n_ticks} ticks of {width}x{height}")
    kind = "a folder of streams without poses" if cameras is None else f"a scene of {len(streams)} training cameras"
    print(f"{out}: {kind}")
    return 0
