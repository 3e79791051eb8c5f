"""Frames of a conventional camera: the files of one camera, and their reader.

conventional/CAMERA/TICK.png is the mean radiance over an exposure that begins at that tick, as 8-bit sRGB: gray [H, W],
or RGB [H, W, 3]. scene.json states the frame rate and the exposure time. A clip shorter than one exposure has no frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, overload

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.images import Float32, UInt8, decode_srgb, read_png
from spike4dgs.benchmark.scene.manifest import Manifest

_DIGITS = 15  # of a tick


@dataclass(frozen=True, eq=False)
class Frame:
    """One exposure. Motion within it is blurred; what is brighter than white is clipped."""

    tick: int  # at which the exposure begins
    t_us: float  # the same in microseconds
    exposure_us: float
    srgb: UInt8  # [H, W] gray or [H, W, 3] RGB, sRGB-encoded

    @property
    def radiance(self) -> Float32:
        """Linear radiance [H, W] or [H, W, 3], 1.0 = white, to the precision of the 8-bit file."""
        return decode_srgb(self.srgb)


@dataclass(frozen=True, eq=False)
class Frames(Sequence[Frame]):
    """The frames of one camera, in order of time. A frame's file is checked and read when the frame is asked for.

    `[frame.t_us for frame in scene.frames("cam_00")]` is `[0.0, 16650.0, 33350.0]` at 20 kHz.
    """

    camera: str
    ticks: tuple[int, ...]  # at which the exposures begin
    shape: tuple[int, int]  # H, W
    rate_hz: float  # ticks per second of the scene's clock
    fps: float
    exposure_us: float
    files: Manifest  # of the scene, with this camera's frames alone

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.ticks)

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[Frame]: ...

    def __getitem__(self, index: int | slice) -> Frame | Sequence[Frame]:
        """Return a frame, or those of a slice. Raises UserError where a file is missing or damaged."""
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        tick = self.ticks[index]
        image = read_png(self.files.path(f"conventional/{self.camera}/{tick:06d}.png"), self.shape)
        return Frame(tick, tick * 1e6 / self.rate_hz, self.exposure_us, image)


def find_frames(meta: Mapping[str, Any], files: Manifest, cameras: Sequence[str]) -> dict[str, Frames]:
    """Return the frames, unread, of those of `cameras` that have some. `meta`: scene.json."""
    found: dict[str, Frames] = {}
    facts: Mapping[str, Any] = meta.get("conventional", {})
    for camera in cameras if facts else ():
        own = files.only(f"conventional/{camera}/")
        if ticks := tuple(sorted(_tick(files, name) for name in own.files)):
            fps, exposure_s = (_fact(files, facts, key) for key in ("fps", "exposure_s"))
            size = int(meta["height"]), int(meta["width"])
            found[camera] = Frames(camera, ticks, size, float(meta["rate_hz"]), fps, exposure_s * 1e6, own)
    return found


def _tick(files: Manifest, name: str) -> int:
    if not (stem := PurePosixPath(name).stem).isdecimal() or len(stem) > _DIGITS:
        raise problem(files.root / name[:200], "a frame named by its tick", "another name", "make the scene again")
    return int(stem)


def _fact(files: Manifest, facts: Mapping[str, Any], key: str) -> float:
    if key not in facts:
        raise problem(files.root / "scene.json", f"conventional/{key}", "no such key", "make the scene again")
    return float(facts[key])


def frames_of(found: Mapping[str, Frames], camera: str, where: Path | str) -> Frames:
    """Return the frames of a camera. Raises UserError where there are none."""
    if camera not in found:
        fix = "use a scene that has conventional/ and is longer than one exposure"
        names = f"those of {', '.join(found)}" if found else "none"
        raise problem(where, f"frames of a conventional camera at {camera}", names, fix)
    return found[camera]
