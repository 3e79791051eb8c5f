"""The scene folder, format `spike4dgs-scene/1`: every generator writes it and every method reads it.

Orientation, rate and camera identity come from scene.json, never from a guess. Every file is checked against the
manifest before it is used, so a damaged stream is refused by whoever reads it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_json
from spike4dgs.benchmark.scene.calibration import Calibration, Recordings, estimate, find_recordings
from spike4dgs.benchmark.scene.camera_state import PERFECT, CameraState
from spike4dgs.benchmark.scene.cameras import Camera, camera_facts, read_cameras
from spike4dgs.benchmark.scene.content import revision_of
from spike4dgs.benchmark.scene.images import encode_srgb, read_exr, read_mask, read_rgb
from spike4dgs.benchmark.scene.manifest import Manifest, check_scene_folder, read_manifest
from spike4dgs.benchmark.scene.other_sensors import EventStream, Frames, events_of, find_events, find_frames, frames_of
from spike4dgs.benchmark.scene.splits import Target as Target
from spike4dgs.benchmark.scene.splits import check_splits, read_targets
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.benchmark.screen.shown import Shown, Table
from spike4dgs.benchmark.spikes.gaps import Gap, read_gaps, refuse_gaps
from spike4dgs.benchmark.spikes.repair import fill_gaps
from spike4dgs.benchmark.spikes.stream import SpikeStream, open_stream

SCHEMA = "spike4dgs-scene/1"
_SHOWN = 4  # thumbnails of a scene


@dataclass(frozen=True, eq=False, repr=False)
class TrainingScene(Shown):
    """The part of a scene that methods get: the clock, and the training cameras with their streams and recordings.

    It has no ground truth, and nothing of a held-out camera: neither its stream nor its frames nor its events.
    """

    id: str
    revision: str
    cameras: tuple[Camera, ...]
    streams: tuple[SpikeStream, ...]
    rate_hz: float
    n_ticks: int
    radiance_gain: float  # spikes per tick of a pixel at radiance 1 (white)
    recordings: tuple[Recordings | None, ...] = ()  # calibration recordings of each camera, if there are any
    found_frames: Mapping[str, Frames] = field(default_factory=dict)  # by camera; see `frames`
    found_events: Mapping[str, EventStream] = field(default_factory=dict)  # by camera; see `events`
    states: Mapping[str, CameraState] = field(default_factory=dict)  # by camera; see `state`
    known_calibrations: tuple[Calibration, ...] = ()  # of each camera, in the place of estimates: of an oracle

    def state(self, camera: str) -> CameraState:
        """Return a camera's clock, gain, dark rate and bad pixels, as far as they were estimated."""
        return self.states.get(camera, PERFECT)

    def frames(self, camera: str) -> Frames:
        """Return the conventional camera's frames beside a training camera, as `Scene.frames` does."""
        return frames_of(self.found_frames, camera, f"{self.id}, training cameras")

    def events(self, camera: str) -> EventStream:
        """Return the event camera's events beside a training camera, as `Scene.events` does."""
        return events_of(self.found_events, camera, f"{self.id}, training cameras")

    @cached_property
    def calibrations(self) -> tuple[Calibration, ...] | None:
        """Each camera's response to light, from its recordings and its state; None unless all have recordings."""
        recorded = [r for r in self.recordings if r is not None]
        if not self.known_calibrations and (not recorded or len(recorded) < len(self.cameras)):
            return None
        found = self.known_calibrations or tuple(map(estimate, recorded))
        return tuple(c.in_dark_of(self.state(s.id).dark) for s, c in zip(self.cameras, found, strict=True))

    @property
    def duration_us(self) -> float:
        """Length of the clip in microseconds."""
        return self.n_ticks * 1e6 / self.rate_hz

    def tick(self, t_us: float) -> int:
        """Return the tick that contains the time `t_us`, clipped to the clip."""
        tick = t_us * self.rate_hz / 1e6 + 1e-6  # the time of a tick's start may be rounded down
        return int(min(max(tick, 0), self.n_ticks - 1))

    def _about(self) -> str:
        given = ", ".join(name for name in ("recordings", "found_frames", "found_events") if getattr(self, name))
        extras = f"; {given.replace('found_', '')}" if given else ""
        return f"{self.id}: {_clip(self.cameras, self.n_ticks, self.rate_hz)}{extras}"

    def _thumbnails(self) -> Iterator[tuple[str, UInt8]]:
        for camera, stream in list(zip(self.cameras, self.streams, strict=True))[:_SHOWN]:
            for _, image in stream._thumbnails():
                yield f"spikes of {camera.id}", image


@dataclass(frozen=True, eq=False, repr=False)
class Scene(Shown):
    """An opened scene folder with one of its splits, which decides `train`, `test`, `targets` and `training`.

    Images are gray linear radiance, [H, W] float32, 1.0 = white.
    """

    root: Path
    meta: dict[str, Any]  # scene.json
    cameras: dict[str, Camera]
    split: str
    targets: tuple[Target, ...]
    manifest: Manifest

    @property
    def id(self) -> str:
        """Identifier, such as `car-0-small`."""
        return str(self.meta["id"])

    @cached_property
    def revision(self) -> str:
        """SHA-256 of what is fitted and scored; see `scene.content`. Texts, versions and encodings do not change it."""
        every_split = read_targets(self.manifest.path("targets.json"), self.meta)
        targets = {name: [[t.camera, t.tick] for t in targets] for name, targets in every_split.items()}
        gaps = [[g.camera, g.first_tick, g.ticks] for g in self.gaps]
        return revision_of(self.meta, camera_facts(self.root), targets, gaps, self.manifest.contents(self.meta))

    @property
    def n_ticks(self) -> int:
        """Length of the clip in ticks."""
        return int(self.meta["n_ticks"])

    @property
    def rate_hz(self) -> float:
        """Ticks per second."""
        return float(self.meta["rate_hz"])

    @property
    def radiance_gain(self) -> float:
        """Spikes per tick of a pixel at radiance 1 (white)."""
        return float(self.meta["radiance_gain"])

    @property
    def train(self) -> tuple[str, ...]:
        """Training cameras."""
        return tuple(self.meta["splits"][self.split]["train"])

    @property
    def test(self) -> tuple[str, ...]:
        """Held-out cameras."""
        return tuple(self.meta["splits"][self.split]["test"])

    @property
    def is_default_split(self) -> bool:
        """True for the split that is used where none is named."""
        return bool(self.split == self.meta["default_split"])

    def t_us(self, tick: int) -> float:
        """Return the time at which a tick starts, in microseconds."""
        return tick * 1e6 / self.rate_hz

    def stream(self, camera: str) -> SpikeStream:
        """Return the packed stream of a camera, checked and memory-mapped.

        Raises UserError for a camera whose stream is kept back, as in the training part of a hidden scene.
        """
        if camera not in self.meta["streams"]:
            raise problem(self.root, f"a stream of {camera}", "none", "use a scene that has it, or another camera")
        path = self.manifest.path(self.meta["streams"][camera])
        c = self.cameras[camera]
        bottom_up, gaps = bool(self.meta["sensor"]["rows_bottom_up"]), tuple(g for g in self.gaps if g.camera == camera)
        size, dead = (c.width, c.height), float(self.meta["sensor"].get("dead_ticks", 0))
        return open_stream(
            path,
            *size,
            self.rate_hz,
            rows_bottom_up=bottom_up,
            n_ticks=self.n_ticks,
            gaps=gaps,
            dead_ticks=dead,
        )

    def recordings(self, camera: str) -> Recordings | None:
        """Return a camera's recordings under uniform light and in the dark; None where the scene has none."""
        c = self.cameras[camera]
        return find_recordings(self.meta, self.manifest, camera, (c.width, c.height))

    def ground_truth(self, target: Target) -> NDArray[np.float32]:
        """Read the radiance of a target, [H, W] float32."""
        return read_exr(self.manifest.path(f"images/{target.name}.exr"), self._shape(target))

    def ground_truth_rgb(self, target: Target) -> NDArray[np.float32]:
        """Read it in colour, [H, W, 3]. Raises UserError where the scene has gray images only."""
        return read_rgb(self.manifest.path(f"images/{target.name}.exr"), self._shape(target))

    def moving(self, target: Target) -> NDArray[np.bool_]:
        """Read the moving region of a target, [H, W] bool, which the `*_dynamic` metrics use."""
        return read_mask(self.manifest.path(f"masks/{target.name}.png"), self._shape(target))

    def _shape(self, target: Target) -> tuple[int, int]:
        return self.cameras[target.camera].height, self.cameras[target.camera].width

    def frames(self, camera: str) -> Frames:
        """Return the frames of the conventional camera at a camera's pose: 60 a second, with motion blur.

        A frame gives its time, its exposure, the 8-bit sRGB image of the file, and linear radiance. The simulator
        writes gray frames, for every camera. Raises UserError where the scene has none, as where the clip is shorter
        than an exposure.
        """
        return frames_of(find_frames(self.meta, self.manifest, (camera,)), camera, self.root)

    def events(self, camera: str) -> EventStream:
        """Return the events of the event camera at a camera's pose: time in microseconds, column, row and polarity.

        The simulator writes events for every camera. Raises UserError where the scene has none.
        """
        return events_of(find_events(self.meta, self.manifest, (camera,)), camera, self.root)

    @cached_property
    def gaps(self) -> tuple[Gap, ...]:
        """Ticks that a recording lacks, in order of camera and tick. Raises UserError where scene.json is damaged."""
        return read_gaps(self.meta["gaps"], dict.fromkeys(self.meta["streams"], self.n_ticks), self.root / "scene.json")

    def _about(self) -> str:
        split = (
            f"split {self.split}: {len(self.train)} training, {len(self.test)} held out, {len(self.targets)} targets"
        )
        return f"{self.id}: {_clip(tuple(self.cameras.values()), self.n_ticks, self.rate_hz)}; {split}"

    def _thumbnails(self) -> Iterator[tuple[str, UInt8]]:
        """Yield the truth of the middle target, and spikes of training cameras."""
        if self.targets and "images" in {name.partition("/")[0] for name in self.manifest.files}:
            target = self.targets[len(self.targets) // 2]
            yield f"truth of {target.name}", encode_srgb(self.ground_truth(target))
        for camera in self.train[: _SHOWN - 1]:
            for _, image in self.stream(camera)._thumbnails():
                yield f"spikes of {camera}", image

    @cached_property
    def training(self) -> TrainingScene:
        """The part of the scene that methods get. The missing ticks of a recording are filled (`spikes.repair`)."""
        cameras = tuple(self.cameras[c] for c in self.train)
        streams = tuple(fill_gaps(self.stream(c)) for c in self.train)
        clock = self.rate_hz, self.n_ticks, self.radiance_gain
        recordings = tuple(self.recordings(c) for c in self.train)
        frames = find_frames(self.meta, self.manifest, self.train)
        events = find_events(self.meta, self.manifest, self.train)
        return TrainingScene(self.id, self.revision, cameras, streams, *clock, recordings, frames, events)


def _clip(cameras: Sequence[Camera], n_ticks: int, rate_hz: float) -> str:
    """Return the cameras and the clip in words."""
    sizes = ", ".join(sorted({f"{c.width}x{c.height}" for c in cameras}))
    clip = f"{n_ticks} ticks at {rate_hz:.6g} Hz ({1e3 * n_ticks / rate_hz:.6g} ms)"
    return f"{len(cameras)} cameras of {sizes} pixels, {clip}"


def open_scene(root: Path | str, allow_gaps: bool = False, split: str | None = None) -> Scene:
    """Read and validate a scene folder, and open it with a split: the scene's default one if None.

    Raises UserError where the folder, scene.json, the cameras or the targets are missing, foreign, damaged or
    inconsistent, where there is no such split, and where a recording has gaps unless `allow_gaps`.
    """
    root = Path(root)
    check_scene_folder(root)
    meta = read_json(root / "scene.json", f"a {SCHEMA} description")
    check_meta(meta, root / "scene.json")
    manifest = read_manifest(root)
    for name in ("scene.json", "transforms_train.json", "transforms_test.json", "targets.json"):
        manifest.path(name)
    cameras = read_cameras(root)
    check_splits(meta, cameras, root / "scene.json")
    targets = read_targets(root / "targets.json", meta)
    chosen = meta["default_split"] if split is None else split
    if chosen not in targets:
        expected = f"a split among {', '.join(meta['splits'])}"
        raise problem(root / "scene.json", expected, repr(chosen), "name one of them")
    scene = Scene(root, meta, Table("cameras", cameras), chosen, targets[chosen], manifest)
    refuse_gaps(scene.gaps, root / "scene.json", allow_gaps)
    return scene


def check_meta(meta: dict[str, Any], path: Path) -> None:
    """Validate scene.json against the shipped JSON Schema. Raises UserError with the first difference."""
    if meta.get("schema") != SCHEMA:
        found = f"schema {meta.get('schema')!r}"
        raise problem(path, f"schema '{SCHEMA}'", found, "it is not a scene of this format: make or import one")
    check_schema(meta, load_schema("spike4dgs.benchmark", "scene.schema.json"), path, "make or import the scene again")


def open_scenes(paths: Sequence[Path], allow_gaps: bool = False, split: str | None = None) -> list[Scene]:
    """Open the scenes of a command line with a split. Raises UserError where there is none."""
    if not paths:
        raise problem("scenes", "at least one scene folder", "none", "make one with `spike4dgs make-dataset`")
    return [open_scene(p, allow_gaps, split) for p in paths]
