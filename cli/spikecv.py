"""`import-spikecv` and `export-spikecv`: SpikeCV folders as scenes, and back."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import OmitArgPrefixes, Positional

from spike4dgs.benchmark.exchange import spikecv
from spike4dgs.benchmark.exchange.recording import Recording
from spike4dgs.benchmark.scene.scene import open_scene


def import_spikecv(
    folder: Positional[Path], out: Path, recording: OmitArgPrefixes[Recording], transforms: Path | None = None
) -> int:
    """Import a SpikeCV folder, or a folder of them (one per camera), as a scene folder or a folder of streams.

    With poses, the result is a scene whose cameras are all for training, without scored images. Without poses, it is a
    folder of streams (stream.json), which `inspect` reads. Labels are not imported. Streams whose H*W is not a multiple
    of 8 are repacked, because ours start every tick on a whole byte. SpikeCV does not store the rate: give --rate-hz.

    Args:
        folder: Folder with config.yaml, or with one such folder per camera; each camera has the name of its folder.
        out: New folder to write.
        transforms: nerfstudio file (JSON) with intrinsics and a pose for each camera, named by the key "camera".
    """
    for stream in spikecv.import_spikecv(folder, out, recording, transforms).values():
        print(f"{stream.source}: {stream.n_ticks} ticks of {stream.width}x{stream.height}")
    return 0


def export_spikecv(scene: Positional[Path], out: Path, allow_gaps: bool = False) -> int:
    """Write the streams of a scene as SpikeCV folders, one per camera, rows bottom-up (SpikeCV's default).

    SpikeCV does not store rate, dead ticks, poses, clock, radiance gain, gaps or scored images, so they are left out.
    Streams whose H*W is not a multiple of 8 are repacked without padding, as SpikeCV does.

    Args:
        scene: Scene folder.
        out: New folder; each camera becomes a folder in it.
        allow_gaps: Accept a recording with gaps.
    """
    opened = open_scene(scene, allow_gaps)
    spikecv.export_spikecv(opened, out)
    for camera in opened.meta["streams"]:
        print(f"{out / camera}: {opened.n_ticks} ticks of {opened.meta['width']}x{opened.meta['height']}")
    dead = opened.meta["sensor"].get("dead_ticks", 0)
    facts = f"{opened.rate_hz:g} ticks per second" + (f", {dead:g} dead ticks" if dead else "")
    print(f"not in SpikeCV's format: {facts}, poses, clock, gain, scored images")
    return 0
