"""Which files of a release are asked for: scenes, cameras, parts, or a window of time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from spike4dgs.benchmark.errors import problem, unknown
from spike4dgs.benchmark.release.index import DESCRIPTION, Member, Release, Sample, SceneEntry, part_of
from spike4dgs.benchmark.spikes.stream import bytes_per_tick


@dataclass(frozen=True)
class Selection:
    """What is asked for; empty means all. The files at the top of a scene always come along.

    Args:
        scenes: Fetch only these scenes.
        cameras: Fetch only the files of these cameras, and the scene's own.
        parts: Fetch only these parts, such as spikes, calibration or images, and the scene's description.
        window_ms: Fetch only the streams, from the first to the second millisecond, to OUT/SCENE-START-STOPms. This is
            a folder of streams to look at, not a scene of the track.
    """

    scenes: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    parts: tuple[str, ...] = ()
    window_ms: tuple[float, float] | None = None

    @property
    def is_whole(self) -> bool:
        """True where scenes come with all their files."""
        return not (self.cameras or self.parts or self.window_ms)

    def check(self, release: Release) -> None:
        """Raise UserError where the release has no such scenes, cameras or parts."""
        scenes = self.entries(release)
        _check("--scenes", self.scenes, release.scenes, release.name)
        _check("--cameras", self.cameras, {c for s in scenes for c in s.streams}, release.name)
        _check("--parts", self.parts, {p for s in scenes for p in s.parts}, release.name)
        if self.window_ms and self.parts:
            raise problem("--window-ms", "no --parts beside it", ", ".join(self.parts), "it fetches streams alone")

    def entries(self, release: Release) -> list[SceneEntry]:
        """Return the scenes that are asked for."""
        return [s for s in release.scenes.values() if not self.scenes or s.id in self.scenes]

    def samples(self, scene: SceneEntry) -> list[Sample]:
        """Return the samples of a scene that files are asked of."""
        return [s for s in scene.samples if self._bytes_of(scene, s)]

    def members(self, members: Iterable[Member], scene: SceneEntry) -> list[Member]:
        """Return those of a shard's members that are asked for."""
        of_scene = [m for m in members if m.scene == scene.id and self._takes_camera(m.camera)]
        if self.window_ms:
            return [m for m in of_scene if m.path == scene.streams.get(m.camera or "")]
        return [m for m in of_scene if self._takes_part(part_of(m.path))]

    def bytes_of(self, scene: SceneEntry) -> int:
        """Return the size of what is asked of a scene; of a window, without the rest of its first and last block."""
        return sum(self._bytes_of(scene, sample) for sample in scene.samples)

    def _bytes_of(self, scene: SceneEntry, sample: Sample) -> int:
        if not self._takes_camera(sample.camera):
            return 0
        if self.window_ms:
            ticks = self.ticks(scene)
            return 0 if sample.camera is None else len(ticks) * bytes_per_tick(scene.width, scene.height)
        return sum(size for part, size in sample.sizes.items() if self._takes_part(part))

    def _takes_camera(self, camera: str | None) -> bool:
        return camera is None or not self.cameras or camera in self.cameras

    def _takes_part(self, part: str) -> bool:
        return not self.parts or part in (*self.parts, DESCRIPTION)

    def ticks(self, scene: SceneEntry) -> range:
        """Return the ticks of the window in a scene. Raises UserError where it has none."""
        if self.window_ms is None:
            return range(scene.n_ticks)
        start, stop = (ms * scene.rate_hz / 1000 for ms in self.window_ms)
        # A window of whole ticks keeps them, whatever the rounding of its milliseconds.
        ticks = range(max(math.floor(start + 1e-6), 0), min(math.ceil(stop - 1e-6), scene.n_ticks))
        if not ticks or start < 0:
            expected = f"milliseconds from 0 to {scene.n_ticks * 1000 / scene.rate_hz:g} ({scene.id})"
            raise problem("--window-ms", expected, "{:g} {:g}".format(*self.window_ms), "shorten the window")
        return ticks


EVERYTHING = Selection()


def _check(option: str, asked: Sequence[str], known: Iterable[str], release: str) -> None:
    names = sorted(known)
    if others := [name for name in asked if name not in names]:
        raise unknown(f"{option} of release {release}", others[0], names)
