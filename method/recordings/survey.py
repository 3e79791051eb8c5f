"""The survey of a recording before a fit: what is missing or wrong is found, repaired or left out, and said.

Missing ticks and bad pixels are filled in the streams (`benchmark.spikes.repair`), so that every part of a method works
as it is; the loss leaves out bad pixels and long gaps. A camera's gain is one number beside the array's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from spike4dgs.benchmark.arrays import Mask
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.calibration import Recordings
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.bad_pixels import BadPixels, find_bad
from spike4dgs.benchmark.spikes.counted_recording import total_counts
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.repair import LONGEST_TICKS, fill_gaps, fill_pixels
from spike4dgs.method.recordings.camera_facts import between_views, from_recordings

LEAST_PRESENT = 0.5  # share of its ticks with which a camera is used: a shorter one would be filled more than recorded
MOST_BAD = 0.5  # share of its pixels with which it is: half of an image tells little, and its recordings may be wrong
MOST_RATIO = 30.0  # of the cameras' mean rates: gains differ by some percent, and what cameras see by two or three
LEAST_GAIN = 0.005  # largest difference from 1 below which gains are left as they are: an estimate's own error


@dataclass(frozen=True, eq=False)
class Survey:
    """A scene to fit, the bad pixels of its cameras, and notes for the report."""

    scene: TrainingScene
    bad: Mapping[str, BadPixels]
    notes: tuple[str, ...]


def survey_streams(scene: TrainingScene) -> Survey:
    """Return a scene without holes in its streams. Poses do not matter.

    Raises UserError where fewer than two cameras have recorded enough, or have enough pixels that work.
    """
    notes: list[str] = []
    scene = _enough(scene, notes)
    _check_exposures(scene)
    filled = tuple(fill_gaps(stream) for stream in scene.streams)
    notes += _gap_notes(scene, replace(scene, streams=filled))
    recordings = scene.recordings or (None,) * len(filled)
    bad = {
        camera.id: find_bad(stream, *((found.flat, found.dark) if found else ()))
        for camera, stream, found in zip(scene.cameras, filled, recordings, strict=True)
    }
    kept = [i for i, camera in enumerate(scene.cameras) if bad[camera.id].all.mean() <= MOST_BAD]
    notes += [f"most pixels of {c.id} are bad: left out" for i, c in enumerate(scene.cameras) if i not in kept]
    scene = _only(replace(scene, streams=filled), kept, "most of whose pixels work")
    masks = [bad[camera.id].all for camera in scene.cameras]
    found = {c.id: replace(scene.state(c.id), bad=m) for c, m in zip(scene.cameras, masks, strict=True) if m.any()}
    scene = replace(
        scene,
        streams=tuple(fill_pixels(s, m) for s, m in zip(scene.streams, masks, strict=True)),
        recordings=tuple(_without(r, m) for r, m in zip(scene.recordings, masks, strict=True))
        if scene.recordings
        else (),
        states={**scene.states, **found},
    )
    return Survey(scene, bad, (*notes, *_pixel_notes([bad[c.id] for c in scene.cameras])))


def survey_gains(scene: TrainingScene) -> tuple[TrainingScene, tuple[str, ...]]:
    """Return a scene with the gain of each camera, from uniform light or else from the views; and notes.

    Gains are relative to their mean: that of all cameras is the scene's own.
    """
    known = scene.calibrations is not None
    gains = from_recordings(scene) if known else between_views(scene)
    if gains is None or abs(gains - 1).max() < LEAST_GAIN:
        return scene, ()
    if gains.max() > MOST_RATIO * gains.min():
        low, high = (scene.cameras[int(i)].id for i in (gains.argmin(), gains.argmax()))
        expected = f"gains that differ by less than {MOST_RATIO:g} times"
        fix = "record uniform light with the exposure of the clip"
        raise problem(f"scene {scene.id}", expected, f"{gains.min():.3g} of {low}, {gains.max():.3g} of {high}", fix)
    states = {c.id: replace(scene.state(c.id), gain=float(g)) for c, g in zip(scene.cameras, gains, strict=True)}
    how = "from the recordings of uniform light" if known else "from points that several cameras see"
    note = f"gains of the cameras from {gains.min():.3f} to {gains.max():.3f} of their mean, estimated {how}: corrected"
    return replace(scene, states={**scene.states, **states}), (note,)


def _enough(scene: TrainingScene, notes: list[str]) -> TrainingScene:
    """Return the scene of those cameras that have recorded most of their ticks."""
    share = [float(present(s.gaps, s.n_ticks).mean()) for s in scene.streams]
    silent = [not s.packed.any() for s in scene.streams]
    kept = [i for i, s in enumerate(share) if s >= LEAST_PRESENT and not silent[i]]
    notes += [f"{c.id} has no spike: left out" for c, s in zip(scene.cameras, silent, strict=True) if s]
    for camera, own in zip(scene.cameras, share, strict=True):
        if own < LEAST_PRESENT:
            notes.append(f"{camera.id} lacks {1 - own:.0%} of its ticks: left out")
    return _only(scene, kept, "that recorded spikes, in most ticks")


def _check_exposures(scene: TrainingScene) -> None:
    """Raise UserError where a camera counts spikes at quite another rate than the others.

    Gains are corrected, but one camera of such a pair is saturated or sees nothing.
    """
    means = {c.id: float(total_counts(s).mean()) / s.n_ticks for c, s in zip(scene.cameras, scene.streams, strict=True)}
    low, high = min(means, key=means.__getitem__), max(means, key=means.__getitem__)
    if means[high] > MOST_RATIO * means[low]:
        expected = f"cameras whose mean rates differ by less than {MOST_RATIO:g} times"
        found = f"{means[low]:.2g} spikes per tick and pixel of {low}, {means[high]:.2g} of {high}"
        raise problem(f"scene {scene.id}", expected, found, "set the exposures alike, or leave the camera out")


def _only(scene: TrainingScene, kept: Sequence[int], why: str) -> TrainingScene:
    """Return the scene of some of its cameras. Raises UserError for fewer than two, where the scene has two."""
    if len(kept) < min(2, len(scene.cameras)):
        fix = "record again, or choose another split"
        raise problem(f"scene {scene.id}", f"two cameras {why}", f"{len(kept)}", fix)
    if len(kept) == len(scene.cameras):
        return scene
    return replace(
        scene,
        cameras=tuple(scene.cameras[i] for i in kept),
        streams=tuple(scene.streams[i] for i in kept),
        recordings=tuple(scene.recordings[i] for i in kept) if scene.recordings else (),
    )


def _without(recordings: Recordings | None, mask: Mask) -> Recordings | None:
    if recordings is None:
        return None
    return replace(recordings, flat=fill_pixels(recordings.flat, mask), dark=fill_pixels(recordings.dark, mask))


def _gap_notes(before: TrainingScene, after: TrainingScene) -> list[str]:
    missing = sum(gap.ticks for stream in before.streams for gap in stream.gaps)
    long = [gap for stream in after.streams for gap in stream.gaps]
    if not missing:
        return []
    share = missing / (before.n_ticks * len(before.streams))
    notes = [f"{missing} ticks are missing ({share:.2%} of all): filled from the spikes around them"]
    for gap in long:
        notes.append(
            f"{gap.camera} lacks ticks [{gap.first_tick}, {gap.stop_tick}), more than {LONGEST_TICKS}: "
            "images there are left out of the loss"
        )
    return notes


def _pixel_notes(bad: Sequence[BadPixels]) -> list[str]:
    if not any(own.all.any() for own in bad):
        return []
    kinds = ", ".join(f"{sum(int(own.kinds[kind].sum()) for own in bad)} {kind}" for kind in bad[0].kinds)
    sources = " and ".join(sorted({own.source for own in bad}))
    return [f"bad pixels of all cameras: {kinds} (from {sources}); left out of the loss, filled from their neighbours"]
