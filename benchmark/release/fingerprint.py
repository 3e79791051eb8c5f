"""The fingerprint of a scene: a small file by which a scene made on another processor is recognised.

Processors round differently, so the same command gives other last bits of radiance, and a few of 10,000 spikes come a
tick earlier or later. The revision is then another one, though no score differs by 0.02 dB. A fingerprint tells such a
scene, which is *equivalent*, from another noise or another world. It holds

    facts     the clock, the cameras, the splits, the targets, the calibration's radiance and lengths
    sample    the bytes of each stream at 2048 positions, which follow from the camera's name: another noise changes a
              sixth of their bits, another processor one of 10,000
    spikes    spikes of each stream in blocks of space and time
    truth     means of each scored image in blocks, clipped to [0, 1], and the moving pixels of each block
    recordings   counts of each flat and dark recording in blocks

The sample bounds the share of differing bits; blocks find what moved or changed in one place.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float64, UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.scene.cameras import camera_facts
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.benchmark.spikes.counted_recording import counted
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.untrusted import Expected, read_npz

FORMAT = "spike4dgs-fingerprint/1"
SAMPLE_BYTES = 2048  # of each stream: 16,384 bits, in which a share of 1 % is seen to a tenth of itself
_BLOCKS = 1000  # of an image at most, and of a clip _PERIODS: the file has some 50 kB for nine cameras
_PERIODS = 10
_LEAST_PX, _LEAST_TICKS = 8, 50
_STEP = 1 / 65535  # of a truth's mean in a file
_ROUNDING = 1e-6  # relative, of facts

# Limits between rounding and noise, chosen on `tiny` and `small` scenes made with 8 lanes and with 16, and with another
# noise: rounding gave 0.0001 and noise 0.16 of the bits; in blocks of truth 0.00003 and 0.0012.
MOST_BITS = 0.01
MOST_SPIKES_RMS, MOST_SPIKES = 5e-4, 0.01  # spikes per tick and pixel, of blocks
MOST_TRUTH_RMS, MOST_TRUTH = 2e-4, 5e-3  # radiance, white is 1, of blocks
MOST_MASK = 2e-3  # share of the pixels: on edges, rays may hit another thing
MOST_COUNTS = 1e-3  # share of the spikes of a recording


@dataclass(frozen=True, eq=False)
class Fingerprint:
    """What a fingerprint file holds. `arrays`: by kind and name, such as `spikes/cam_00` or `truth/cam_04/000120`."""

    scene: str
    revision: str
    facts: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Match:
    """A scene next to a fingerprint: why it is another one (nothing for an equivalent scene), and the share of bits."""

    revision: str  # of the fingerprint
    bits: float  # share of the sampled bits of all streams that differ
    reasons: tuple[str, ...]

    @property
    def is_equivalent(self) -> bool:
        """True where the scene differs by rounding alone."""
        return not self.reasons


def make_fingerprint(scene: Scene) -> Fingerprint:
    """Return the fingerprint of a scene."""
    arrays: dict[str, NDArray[Any]] = {}
    for camera in sorted(scene.meta["streams"]):
        stream = scene.stream(camera)
        arrays[f"sample/{camera}"] = _sample(stream, f"{scene.id}/{camera}")
        counts = [stream.counts(start, stop).astype(np.int64) for start, stop in _periods(stream.n_ticks)]
        arrays[f"spikes/{camera}"] = np.stack([_block_sums(of_part) for of_part in counts])
        if recordings := scene.recordings(camera):
            for kind in ("flat", "dark"):
                total = counted(getattr(recordings, kind)).total
                arrays[f"recordings/{kind}/{camera}"] = _block_sums(total.astype(np.int64))
    for target in _every_target(scene):
        truth = np.clip(scene.ground_truth(target).astype(np.float64), 0, 1)
        means = _block_sums(truth) / _block_sums(np.ones(truth.shape))
        arrays[f"truth/{target.name}"] = np.round(means / _STEP).astype(np.uint16)
        arrays[f"masks/{target.name}"] = _block_sums(scene.moving(target).astype(np.int64)).astype(np.uint16)
    return Fingerprint(scene.id, scene.revision, _facts(scene), {k: _small(v) for k, v in arrays.items()})


def compare(scene: Scene, reference: Fingerprint) -> Match:
    """Compare a scene with the fingerprint of another rendering of it."""
    own = make_fingerprint(scene)
    if (reasons := tuple(_other_facts(own.facts, reference.facts))) or own.arrays.keys() != reference.arrays.keys():
        reasons = reasons or ("other files: cameras, images or recordings",)
        return Match(reference.revision, 1.0, reasons)
    pairs = {key: (own.arrays[key], reference.arrays[key]) for key in own.arrays}
    if other := next((key for key, (a, b) in pairs.items() if a.shape != b.shape), None):
        return Match(reference.revision, 1.0, (f"{other}: another size",))
    samples = [pair for key, pair in pairs.items() if key.startswith("sample/")]
    differing = sum(int(np.bitwise_count(a ^ b).sum()) for a, b in samples)
    total = 8 * sum(a.size for a, _ in samples)
    bits, bound = differing / total, _bound(differing, total)
    reasons = (
        (f"{bits:.2%} of the spike bits differ, {MOST_BITS:.0%} at most by rounding",) if bound > MOST_BITS else ()
    )
    return Match(reference.revision, bits, (*reasons, *_other_blocks(scene, pairs)))


def write_fingerprint(path: Path, fingerprint: Fingerprint) -> None:
    """Write a fingerprint as a compressed .npz. Equal fingerprints give equal bytes."""
    head = {"format": FORMAT, "scene": fingerprint.scene, "revision": fingerprint.revision, "facts": fingerprint.facts}
    text = np.frombuffer(json.dumps(head, sort_keys=True).encode(), np.uint8)
    with atomic_path(path) as part, zipfile.ZipFile(part, "w") as file:
        for name, values in {"head": text, **fingerprint.arrays}.items():
            member = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            member.compress_type = zipfile.ZIP_DEFLATED
            with file.open(member, "w") as f:
                np.lib.format.write_array(f, np.ascontiguousarray(values), (1, 0), allow_pickle=False)


def read_fingerprint(path: Path) -> Fingerprint:
    """Read a fingerprint. Raises UserError where the file is missing, damaged, or none."""
    return _read(path, None)


def read_facts(path: Path) -> Mapping[str, Any]:
    """Return a fingerprint's facts alone: its other arrays are a hundred times as much. Raises UserError as well."""
    return _read(path, {"head": Expected("u", (None,))}).facts


def _read(path: Path, wanted: dict[str, Expected] | None) -> Fingerprint:
    what, fix = f"a fingerprint ({FORMAT})", "restore the file"
    arrays = read_npz(path, what, wanted, fix)
    try:
        head = json.loads(arrays.pop("head").astype(np.uint8).tobytes())
        if head["format"] != FORMAT:
            raise ValueError(f"format {head['format']!r}"[:80])
        return Fingerprint(str(head["scene"]), str(head["revision"]), dict(head["facts"]), arrays)
    except (KeyError, TypeError, ValueError, RecursionError) as e:
        raise problem(path, what, f"damaged data ({str(e)[:200]})", fix) from None


def _sample(stream: SpikeStream, name: str) -> UInt8:
    """Return the bytes of a stream at SAMPLE_BYTES positions that follow from a name."""
    seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
    at = np.random.PCG64(seed).random_raw(SAMPLE_BYTES) % np.uint64(stream.packed.size)
    ticks, columns = np.divmod(np.sort(at).astype(np.int64), stream.packed.shape[1])
    return np.asarray(stream.packed[ticks, columns])


def _periods(n_ticks: int) -> list[tuple[int, int]]:
    """Return the first tick and the end of each part of a clip; the last part may be shorter."""
    length = min(max(-(-n_ticks // _PERIODS), _LEAST_TICKS), 65535)
    return [(start, min(start + length, n_ticks)) for start in range(0, n_ticks, length)]


def _block_sums(image: NDArray[Any]) -> NDArray[Any]:
    """Return the sums of an image [H, W] in square blocks, at most _BLOCKS of them; those at the edges are smaller."""
    side = _LEAST_PX
    while -(-image.shape[0] // side) * -(-image.shape[1] // side) > _BLOCKS:
        side *= 2
    rows = np.add.reduceat(image, range(0, image.shape[0], side), axis=0)
    return np.asarray(np.add.reduceat(rows, range(0, image.shape[1], side), axis=1))


def _small(values: NDArray[Any]) -> NDArray[Any]:
    """Return whole numbers as the smallest type that holds them."""
    return values if values.dtype in (np.uint8, np.uint16) else values.astype(np.min_scalar_type(int(values.max())))


def _every_target(scene: Scene) -> list[Any]:
    targets = [open_scene(scene.root, allow_gaps=True, split=split).targets for split in scene.meta["splits"]]
    return sorted({target for of_split in targets for target in of_split})


def _facts(scene: Scene) -> dict[str, Any]:
    meta = scene.meta
    names = ("rate_hz", "n_ticks", "radiance_gain", "width", "height", "sensor", "gaps", "splits", "calibration")
    cameras = {f"camera {name}": facts for name, facts in camera_facts(scene.root).items()}
    targets = {"targets": [t.name for t in _every_target(scene)]}
    facts = {**{name: meta.get(name) for name in names}, **cameras, **targets}
    return dict(json.loads(json.dumps(facts)))


def _other_facts(own: Mapping[str, Any], other: Mapping[str, Any]) -> Iterator[str]:
    for name in sorted(own.keys() | other.keys()):
        if not same_facts(own.get(name), other.get(name), _ROUNDING):
            yield f"another {name}"


def same_facts(a: Any, b: Any, rounding: float) -> bool:
    """Return whether two JSON values are equal but for a relative difference of their fractional numbers."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same_facts(a[key], b[key], rounding) for key in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(same_facts(x, y, rounding) for x, y in zip(a, b, strict=True))
    if isinstance(a, float) and isinstance(b, float | int):
        return abs(a - b) <= rounding * max(1.0, abs(a))
    return bool(a == b)


def _bound(differing: int, total: int) -> float:
    """Return the upper limit of a share at 99.9 %, of `differing` among `total` (Clopper and Pearson)."""
    from scipy.stats import beta

    return 1.0 if differing >= total else float(beta.ppf(0.999, differing + 1, total - differing))


def _other_blocks(scene: Scene, pairs: Mapping[str, tuple[NDArray[Any], NDArray[Any]]]) -> Iterator[str]:
    """Yield a line for each camera's streams, images and recordings whose blocks differ by more than rounding."""
    camera = next(iter(scene.cameras.values()))
    ones = np.ones((camera.height, camera.width), np.int64)
    pixels = _block_sums(ones).astype(np.float64)
    ticks = np.array([stop - start for start, stop in _periods(scene.n_ticks)], np.float64)
    for key, (a, b) in pairs.items():
        kind = key.partition("/")[0]
        error = a.astype(np.float64) - b
        if kind == "spikes":
            yield from _beyond(key, error / pixels / ticks[:, None, None], MOST_SPIKES_RMS, MOST_SPIKES)
        elif kind == "truth":
            yield from _beyond(key, error * _STEP, MOST_TRUTH_RMS, MOST_TRUTH)
        elif kind == "masks" and np.abs(error).sum() > MOST_MASK * ones.size:
            yield f"{key}: other pixels move, {np.abs(error).sum() / ones.size:.2%} or more"
        elif kind == "recordings" and np.abs(error).sum() > MOST_COUNTS * b.sum():
            yield f"{key}: other counts, {np.abs(error).sum() / b.sum():.2%} or more"


def _beyond(key: str, error: Float64, most_rms: float, most: float) -> Iterator[str]:
    rms, largest = float(np.sqrt(np.mean(error**2))), float(np.abs(error).max(initial=0))
    if rms > most_rms or largest > most:
        yield f"{key}: blocks differ by {rms:.2g} RMS, {largest:.2g} at most; rounding gives {most_rms:g}, {most:g}"
