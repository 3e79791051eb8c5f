"""What a bare stream does not say of its recording, and the folder that both together become."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import filling
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.writer import SceneDescription, finish_scene, stream_name
from spike4dgs.benchmark.spikes.bits import orient
from spike4dgs.benchmark.spikes.folder import write_stream_folder
from spike4dgs.benchmark.spikes.sensor_model import MOST_DEAD_TICKS
from spike4dgs.benchmark.spikes.stream import SpikeStream, SpikeWriter, open_stream
from spike4dgs.benchmark.untrusted import MAX_GAIN, MAX_HZ, check_ids


@dataclass(frozen=True)
class Recording:
    """Facts of a recording that its files do not state.

    Args:
        rate_hz: Ticks per second.
        radiance_gain: For a scene, spikes per tick of a pixel at radiance 1 (white). If it is 1, radiance is in spikes
            per tick.
        rows_top_down: The files store the top row first (these cameras usually store the bottom row first).
        mirrored: The files store each row from right to left; the result stores it from left to right.
        dead_ticks: Ticks after each spike in which a pixel collects no light.
        licence: Licence of the scene.
    """

    rate_hz: float
    radiance_gain: float = 1.0
    rows_top_down: bool = False
    mirrored: bool = False
    dead_ticks: float = 0.0
    licence: str = "unknown"

    def check(self, option: str, poses: Path | None) -> None:
        """Raise UserError for numbers that no recording has, and for facts of a scene without poses, from `option`."""
        if not (0 < self.rate_hz <= MAX_HZ and 0 < self.radiance_gain <= MAX_GAIN):
            found = f"{self.rate_hz:g}, {self.radiance_gain:g}"
            raise problem("--rate-hz and --radiance-gain", f"positive numbers, at most {MAX_HZ:g}", found, "correct it")
        if not 0 <= self.dead_ticks <= MOST_DEAD_TICKS:
            raise problem("--dead-ticks", f"0 to {MOST_DEAD_TICKS}", f"{self.dead_ticks:g}", "state the sensor's")
        for name, stated in (("--licence", self.licence != "unknown"), ("--radiance-gain", self.radiance_gain != 1)):
            if stated and poses is None:
                expected = f"{option} beside it: streams without poses state none"
                raise problem(name, expected, "none", f"add {option}, or leave {name} out")


@dataclass(frozen=True)
class Source:
    """A stream of another program's file: its size in pixels, its length, and its ticks in our layout."""

    width: int
    height: int
    n_ticks: int
    parts: Iterable[UInt8]  # some ticks at a time, packed


def write_recording(
    out: Path, sources: Mapping[str, Source], cameras: tuple[Camera, ...] | None, recording: Recording, kind: str
) -> dict[str, SpikeStream]:
    """Copy streams by camera to a new folder, of streams or with cameras a scene, and return them.

    A scene has no truth, and all its cameras train. `kind` is the source in its description. Raises UserError before
    anything is written where the folder is not new or its name is no scene's, and where a scene's streams differ in
    size or length.
    """
    if cameras is not None:
        check_ids([out.resolve().name], "scene", "--out", "choose another name")
        shapes = sorted({(s.width, s.height, s.n_ticks) for s in sources.values()})
        if len(shapes) > 1:
            found = " and ".join(f"{w}x{h}x{n}" for w, h, n in shapes)
            raise problem("streams", "one size and length for one scene", found, "cut them to one length")
    with filling(out):
        streams = dict(_copies(out, sources, cameras, recording))
        if cameras is None:
            write_stream_folder(out, streams, {"source": {"kind": kind}})
        else:
            _write_scene(out, streams, cameras, recording, kind)
    return streams


def _copies(
    out: Path, sources: Mapping[str, Source], cameras: tuple[Camera, ...] | None, recording: Recording
) -> Iterator[tuple[str, SpikeStream]]:
    for camera, source in sources.items():
        target = out / (f"{camera}.dat" if cameras is None else stream_name(camera))
        with SpikeWriter(target, source.width, source.height) as writer:
            for packed in source.parts:
                writer.write(orient(packed, source.width, source.height, False, recording.mirrored))
        bottom_up, dead = not recording.rows_top_down, recording.dead_ticks
        size = source.width, source.height
        yield camera, open_stream(target, *size, recording.rate_hz, rows_bottom_up=bottom_up, dead_ticks=dead)


def _write_scene(
    out: Path, streams: Mapping[str, SpikeStream], cameras: tuple[Camera, ...], recording: Recording, kind: str
) -> None:
    first = streams[cameras[0].id]
    name = out.resolve().name
    finish_scene(
        out,
        SceneDescription(
            id=name,
            title=f"Recording {name}",
            licence=recording.licence,
            cameras=cameras,
            train=tuple(c.id for c in cameras),
            test=(),
            rate_hz=first.rate_hz,
            n_ticks=first.n_ticks,
            radiance_gain=recording.radiance_gain,
            targets=(),
            sensor={
                "model": "unknown",
                "rows_bottom_up": first.rows_bottom_up,
                **({"dead_ticks": first.dead_ticks} if first.dead_ticks else {}),
            },
            source={"kind": kind},
            clock={"t0_ns": 0, "source": "unknown"},
            sync={"method": "unknown", "max_error_us": None},
        ),
    )
