"""`images`: the images of a recording, from its spikes alone: PNG, EXR and a slow-motion video."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from tyro.conf import OmitArgPrefixes, Positional

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.exchange.streams import DAT_FILE, DatFile, open_streams
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.benchmark.spikes.counted_recording import mean_rate
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.spikes.trains import spike_trains, trains_bytes
from spike4dgs.benchmark.untrusted import MAX_GAIN
from spike4dgs.cli.options import WHITE, check_names, warn_of_size, white_of
from spike4dgs.generators.recorder.resources import free_bytes
from spike4dgs.method.images.clip_images import ClipImages, clip_video, write_clip_images

_MOST_FPS = 1000.0
_GATHERING = ("adaptive", "intervals", "msdi")  # makers that hold the spike trains of a clip


def images(
    path: Positional[Path],
    *,
    out: Path,
    method: str = "tfi",
    every: int = 20,
    dat_file: OmitArgPrefixes[DatFile] = DAT_FILE,
    camera: tuple[str, ...] = (),
    radiance_gain: float | None = None,
    fps: float = 30.0,
    device: str = "auto",
    allow_gaps: bool = False,
) -> int:
    """Make images of a recording from its spikes: each as PNG and EXR, and all as a slow-motion video.

    OUT/CAMERA contains the images, named by their ticks, and OUT/CAMERA.mp4 is the video. PNG is 8-bit sRGB; EXR is
    linear radiance, in which 1 is white. Give the size and rate of a .dat file; a folder states its own. The same
    command keeps finished images and resumes a stopped run. It never overwrites other images.

    Args:
        path: A headerless .dat file, a folder of imported streams, or a scene folder.
        out: Folder for the images.
        method: The image maker: tfp, tfi, tfstp, spk2img, adaptive, intervals or msdi; with downloaded weights also
            ssml, ssir, spikeclip or scflow-tfp.
        every: Ticks from one image to the next.
        camera: Names of cameras; if left out, all of a folder of streams, or the training cameras of a scene.
        radiance_gain: Spikes per tick of white. If left out, it is the scene's, or for bare streams the charge per tick
            that 1 % of the pixels exceed.
        fps: Frames per second of the video.
        device: Device of a method with a network: auto, cpu or cuda.
        allow_gaps: Accept a recording with gaps. Images at missing ticks are left out.
    """
    check_names("--method", [method], IMAGES)
    for option, value, least, most, expected in (
        ("--every", every, 1, math.inf, "1 tick or more"),
        ("--fps", fps, 1e-3, _MOST_FPS, f"0.001 to {_MOST_FPS:g}"),
        ("--radiance-gain", radiance_gain, 1e-6, MAX_GAIN, f"1e-06 to {MAX_GAIN:g} spikes per tick"),
    ):
        if value is not None and not least <= value <= most:
            raise problem(option, expected, f"{value:g}", "correct it")
    streams, white = _streams(path, dat_file, camera, allow_gaps)
    if not path.is_dir():
        warn_of_size(streams)
    if method in _GATHERING:
        _check_memory(method, streams)
    gain = radiance_gain or white or white_of(list(map(mean_rate, streams.values())), list(streams.values()))
    source = "given" if radiance_gain else "the scene's" if white else f"what {100 - WHITE} % of the pixels exceed"
    print(f"{method} images of {', '.join(streams)}; white is {gain:.4g} spikes per tick, {source}")
    maker = IMAGES[method].on(device)
    for name, stream in streams.items():
        wanted = ClipImages(name, stream, maker, every, gain, fps)
        spike_trains.cache_clear()  # of the camera before: memory was checked for those of one
        made = write_clip_images(out, wanted)
        count, seconds = len(wanted.ticks), len(wanted.ticks) / fps
        print(f"{out / name}: {count} PNG and {count} EXR images" + ("" if made else ", finished before and kept"))
        print(f"{clip_video(out, name)}: {seconds:.2f} s at {fps:g} frames/s, {wanted.slow_motion:.4g} times slower")
    return 0


def _streams(
    path: Path, dat_file: DatFile, cameras: Sequence[str], allow_gaps: bool
) -> tuple[dict[str, SpikeStream], float | None]:
    """Return the streams by camera, and a scene's gain. Raises UserError for a camera that is not there."""
    opened = open_streams(path, dat_file, allow_gaps)
    known = list(opened.cameras) if isinstance(opened, Scene) else list(opened)
    if missing := [name for name in cameras if name not in known]:
        raise problem("--camera", f"among {', '.join(known)}", missing[0], "correct the name")
    if isinstance(opened, Scene):
        return {name: opened.stream(name) for name in cameras or opened.train}, opened.radiance_gain
    return {name: opened[name] for name in cameras or known}, None


def _check_memory(method: str, streams: Mapping[str, SpikeStream]) -> None:
    """Raise UserError where the spike trains of a stream do not fit into memory."""
    free = free_bytes()
    for name, s in streams.items():
        if (need := trains_bytes(s)) > free:
            expected = f"{need / 1e9:.1f} GB of free memory for the spike trains of {name}"
            raise problem(
                f"--method {method}", expected, f"{free / 1e9:.1f} GB", "take another method, or a shorter clip"
            )
