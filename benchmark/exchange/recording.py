"""What a bare stream does not say of its recording, and the folder that both together become."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.writer import SceneDescription, finish_scene, stream_name
from spike4dgs.benchmark.spikes.folder import write_stream_folder
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.untrusted import MAX_GAIN, MAX_HZ


@dataclass(frozen=True)
class Recording:
    """Facts of a recording that its files do not state.

    Args:
        rate_hz: Ticks per second.
        radiance_gain: Of a scene, spikes per tick of a pixel at radiance 1 (white). With 1, radiance is in spikes per
            tick.
        rows_top_down: The files store the top row first. The usual order of this camera is bottom row first.
        licence: Licence of a scene.
    """

    rate_hz: float
    radiance_gain: float = 1.0
    rows_top_down: bool = False
    licence: str = "unknown"

    def check(self, option: str, poses: Path | None) -> None:
        """Raise UserError for numbers that no recording has, and for facts of a scene without poses, from `option`."""
        if not (0 < self.rate_hz <= MAX_HZ and 0 < self.radiance_gain <= MAX_GAIN):
            found = f"{self.rate_hz:g}, {self.radiance_gain:g}"
            raise problem("--rate-hz and --radiance-gain", f"positive numbers, at most {MAX_HZ:g}", found, "correct it")
        for name, stated in (("--licence", self.licence != "unknown"), ("--radiance-gain", self.radiance_gain != 1)):
            if stated and poses is None:
                expected = f"{option} beside it: streams without poses state none"
                raise problem(name, expected, "none", f"add {option}, or leave {name} out")


def stream_path(out: Path, camera: str, cameras: tuple[Camera, ...] | None) -> Path:
    """Return where a stream lies in the folder that `write_recording` describes."""
    return out / (f"{camera}.dat" if cameras is None else stream_name(camera))


def write_recording(
    out: Path, streams: Mapping[str, SpikeStream], cameras: tuple[Camera, ...] | None, recording: Recording, kind: str
) -> None:
    """Describe streams that are already in `out`: without cameras as a folder of streams, with them as a scene.

    A scene's streams have one length; it has no truth, and all its cameras train. `kind` is the source in its
    description.
    """
    if cameras is None:
        write_stream_folder(out, streams, {"source": {"kind": kind}})
        return
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
            sensor={"model": "unknown", "rows_bottom_up": first.rows_bottom_up},
            source={"kind": kind},
            clock={"t0_ns": 0, "source": "unknown"},
            sync={"method": "unknown", "max_error_us": None},
        ),
    )
