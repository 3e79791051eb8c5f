"""How far two scenes of the same cameras and clock are apart: facts that no noise changes, and what noise changes.

No noise changes clock, cameras, splits, targets, geometry and sensors. Numbers of these that differ by rounding alone
count as equal: another processor or library may round otherwise. Noise changes spikes, truth and masks. It is
independent from pixel to pixel and so falls in the means of blocks; a change of the world does not.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.release.fingerprint import same_facts
from spike4dgs.benchmark.scene.cameras import camera_facts
from spike4dgs.benchmark.scene.images import Geometry, read_geometry
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.benchmark.spikes.counted_recording import counted
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.untrusted import read_npz

_ROUNDING = 1e-9  # relative, of facts in float64
_MAP_ROUNDING = 1e-5  # relative, of the sensors' maps, which are float32
_DEPTH = 1e-3  # relative: what a ray hits, in float32
MOST_PIXELS = 1e-3  # share of pixels, on edges, where rays may hit another thing by rounding


def differing_facts(made: Scene, reference: Scene) -> list[str]:
    """Return one line for each fact that differs by more than rounding; none for scenes of one world and one sensor."""
    own, other = _facts(made), _facts(reference)
    found = [
        f"{name}: {_how(own.get(name), other.get(name))}"
        for name in sorted(own.keys() | other.keys())
        if not same_facts(own.get(name), other.get(name), _ROUNDING)
    ]
    return found or [*_sensors(made, reference), *_geometry(made, reference)]


def _facts(scene: Scene) -> dict[str, Any]:
    meta = scene.meta
    by_camera = camera_facts(scene.root).items()
    cameras = {f"{key} of {name}": value for name, own in by_camera for key, value in own.items()}
    targets = {
        f"targets of {split}": [t.name for t in open_scene(scene.root, allow_gaps=True, split=split).targets]
        for split in meta["splits"]
    }
    names = "rate_hz", "n_ticks", "radiance_gain", "width", "height", "sensor", "gaps", "default_split", "calibration"
    facts = {name: meta.get(name) for name in names}
    return {**facts, **cameras, **targets, **{f"split {name}": split for name, split in meta["splits"].items()}}


def _how(own: Any, other: Any) -> str:
    if isinstance(own, list) and isinstance(other, list) and own and len(own) == len(other):
        if all(isinstance(value, float | list) for value in (*own, *other)):  # a pose or a lens
            return f"by up to {np.abs(np.subtract(own, other)).max():.3g}"
    return f"{_short(own)}, reference {_short(other)}"


def _short(value: Any) -> str:
    text = "none" if value is None else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _sensors(made: Scene, reference: Scene) -> Iterator[str]:
    """Yield a line for each camera whose maps, or counts under uniform light and in the dark, differ."""
    for camera in made.cameras:
        maps = [_maps(scene, camera) for scene in (made, reference)]
        if maps[0].keys() != maps[1].keys() or any(
            not np.allclose(maps[0][name], maps[1][name], rtol=_MAP_ROUNDING, atol=0) for name in maps[0]
        ):
            yield f"gain or dark map of {camera}"
            continue
        own, other = made.recordings(camera), reference.recordings(camera)
        for kind in ("flat", "dark") if own and other else ():
            counts = [counted(getattr(recordings, kind)).total for recordings in (own, other)]
            share = float(np.mean(counts[0] != counts[1]))
            if share > MOST_PIXELS:
                yield f"{kind} recording of {camera}: other counts at {share:.2%} of the pixels"


def _maps(scene: Scene, camera: str) -> dict[str, Any]:
    name = f"truth/{camera}.npz"
    return read_npz(scene.manifest.path(name), "a sensor's maps") if name in scene.manifest.files else {}


def _geometry(made: Scene, reference: Scene) -> Iterator[str]:
    """Yield a line where another thing or another depth lies under some images: how many, and the worst."""
    names = [n for n in made.manifest.files if n.startswith("geometry/") and n in reference.manifest.files]
    shares = {n: _other_geometry(*(read_geometry(s.manifest.path(n)) for s in (made, reference))) for n in names}
    if differing := {share: name for name, share in shares.items() if share > MOST_PIXELS}:
        worst = max(differing)
        count = sum(share > MOST_PIXELS for share in shares.values())
        yield f"depth or thing in {count} of {len(names)} images, most in {differing[worst]}: {worst:.2%} of the pixels"


def _other_geometry(a: Geometry, b: Geometry) -> float:
    """Return the share of the pixels whose depth or thing differs."""
    near = np.isclose(a.depth, b.depth, rtol=_DEPTH, atol=0)  # infinite depths are equal
    return float(np.mean(~near | (a.ids != b.ids)))


BLOCK_PX = 8  # means of 64 pixels have an eighth of the noise
WINDOW_TICKS = 100  # of spike counts: 5 ms at 20 kHz
_TICKS = 256  # compared at a time


@dataclass(frozen=True)
class Difference:
    """The difference of one camera between two scenes. Radiance and spikes per tick are linear, 1 is white or always.

    Attributes:
        bits: share of the spike bits that differ.
        spikes_block_rms, spikes_block_max: of the means of spikes per tick in blocks of BLOCK_PX and WINDOW_TICKS.
        truth_rms: of the radiance of all images, clipped to [0, 1]; None where the camera has no images.
        truth_block_rms, truth_block_max: of its means in blocks of BLOCK_PX.
        masks: share of the pixels of all masks, the moving regions, that differ; None where there are none.
    """

    bits: float
    spikes_block_rms: float
    spikes_block_max: float
    truth_rms: float | None = None
    truth_block_rms: float | None = None
    truth_block_max: float | None = None
    masks: float | None = None

    @property
    def truth_db(self) -> float | None:
        """The PSNR between the truths; None where there are none or where they are equal."""
        return -20 * float(np.log10(self.truth_rms)) if self.truth_rms else None

    @property
    def record(self) -> dict[str, Any]:
        """The values as JSON."""
        return {**asdict(self), "truth_db": self.truth_db}


def difference(a: Scene, b: Scene, camera: str) -> Difference:
    """Return how much a camera differs between two scenes of one clock, size and list of images."""
    streams = a.stream(camera), b.stream(camera)
    blocks = _counted_blocks(*streams)
    spikes = bits_that_differ(*streams), _rms(blocks), float(np.abs(blocks).max(initial=0))
    errors = [error for target in images_of(a, camera) if (error := truth_error(a, b, target)) is not None]
    masks = _masks_that_differ(a, b, camera)
    if not errors:
        return Difference(*spikes, masks=masks)
    means = np.stack([block_means(error) for error in errors])
    return Difference(*spikes, _rms(np.stack(errors)), _rms(means), float(np.abs(means).max(initial=0)), masks)


def images_of(scene: Scene, camera: str) -> list[Target]:
    """Return all ground-truth images of a camera, in order of time."""
    names = sorted(n for n in scene.manifest.files if n.startswith(f"images/{camera}/"))
    return [Target(camera, int(name.rpartition("/")[2].removesuffix(".exr"))) for name in names]


def truth_error(a: Scene, b: Scene, target: Target) -> Float64 | None:
    """Return the difference of two truths [H, W], clipped to [0, 1] as for a score.

    None if `b` lacks the image, or has it in another size.
    """
    if f"images/{target.name}.exr" not in b.manifest.files:
        return None
    first, second = (np.clip(scene.ground_truth(target).astype(np.float64), 0, 1) for scene in (a, b))
    return np.asarray(first - second) if first.shape == second.shape else None


def _masks_that_differ(a: Scene, b: Scene, camera: str) -> float | None:
    """Return the share of the pixels of a camera's masks that differ; None where no mask is in both scenes."""
    names = a.manifest.files.keys() & b.manifest.files.keys()
    targets = [t for t in images_of(a, camera) if f"masks/{t.name}.png" in names]
    return float(np.mean([np.mean(a.moving(t) != b.moving(t)) for t in targets])) if targets else None


def bits_that_differ(a: SpikeStream, b: SpikeStream) -> float:
    """Return the share of the pixels and ticks of two streams at which one fires alone."""
    found = 0
    for start in range(0, a.n_ticks, _TICKS):
        part = slice(start, start + _TICKS)
        found += int(np.bitwise_count(a.packed[part] ^ b.packed[part]).sum(dtype=np.int64))
    return found / (a.n_ticks * a.width * a.height)


def block_means(image: Float64) -> Float64:
    """Return the means of an image [H, W] in blocks of BLOCK_PX; what is over at the right and below is left out."""
    height, width = (n // BLOCK_PX for n in image.shape)
    blocks = image[: height * BLOCK_PX, : width * BLOCK_PX].reshape(height, BLOCK_PX, width, BLOCK_PX)
    return np.asarray(blocks.mean(axis=(1, 3)))


def _counted_blocks(a: SpikeStream, b: SpikeStream) -> Float64:
    """Return the differences of spikes per tick in blocks of pixels and windows of ticks."""
    length = min(WINDOW_TICKS, a.n_ticks)
    starts = range(0, a.n_ticks - length + 1, length)
    counts = [a.counts(t, t + length).astype(np.float64) - b.counts(t, t + length) for t in starts]
    return np.stack([block_means(c / length) for c in counts])


def _rms(values: Float64) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0
