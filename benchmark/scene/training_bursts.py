"""Training bursts: radiance at the cameras of an array around some instants, for networks that learn from many views.

`make-msdi-data` writes them and `train-msdi` reads them: one safetensors file for each variant of a world. In a file R
rigs of V cameras view the scene, each at I instants. A burst is the radiance from REACH ticks before an instant to
REACH after it; spikes are made of it anew at every use. Only pixels in which something moves, or its shadow, are stored
for each instant. Further rigs see the world at rest, as it is at one instant: nothing moves in them, and their light is
the same at any time. Below, R includes them:

| tensor | type and shape | what it is |
|---|---|---|
| `still` | half [R, V, H, W] | radiance of the background |
| `still_depth` | half [R, V, H, W] | metres along the optical axis to the background, inf: nothing |
| `w2c`, `K` | double [R, V, 4, 4], [R, V, 3, 3] | cameras, OpenCV, pixel centres at +0.5 |
| `gain`, `dark` | half [V, H, W] | maps of V sensors: relative sensitivity, spikes per tick in the dark |
| `given.r.i` | uint8 [V H W / 8, rounded up] | a bit for each pixel: whether rig r stores it for its instant i |
| `values.r.i` | half [k, P] | radiance of the stored pixels at k ticks, evenly from -REACH to REACH; k is odd |
| `depth.r.i` | half [P] | their depth at the instant |

Between the k ticks radiance is linear. The metadata's one entry holds the facts (`BurstFacts`) as JSON.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Float64, Half, Mask
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.json_values.text import parse_json
from spike4dgs.benchmark.untrusted import MAX_GAIN, MAX_SIDE, check_header, is_id, positive, shown, whole
from spike4dgs.benchmark.variants import HIDDEN_VARIANTS

Arrays = dict[str, NDArray[Any]]

REACH = 21  # ticks to each side: a window of 41 around the instant, or the same played backwards, lies within

_SCHEMA = "spike4dgs-bursts/1"
# Of a rig at rest: no pixel is given, in three images of the burst.
_NOTHING = (np.zeros(0, np.uint8), np.zeros((3, 0), np.float16), np.zeros(0, np.float16))
_MOST_VALUES = 1 << 27  # radiances of a burst: 512 MB
_MOST_VIEWS = 10_000  # of a rig, and rigs and instants of a file
_FIX = "delete it and run `spike4dgs make-msdi-data` again"


@dataclass(frozen=True)
class BurstFacts:
    """The facts that a file states of itself."""

    world: str
    variant: int
    seed: int
    width: int
    height: int
    views: int
    rigs: int
    instants: int  # of each rig
    spp: int  # samples per pixel
    radiance_gain: float  # spikes per tick of a pixel at radiance 1 (white)
    photons_per_spike: float  # of its shot noise
    resting: int = 0  # further rigs, which see the world at rest at an instant

    @property
    def id(self) -> str:
        """Such as `car-17`."""
        return f"{self.world}-{self.variant}"

    @property
    def hidden(self) -> bool:
        """True for a variant that is kept for scores."""
        return self.variant in HIDDEN_VARIANTS


@dataclass(frozen=True, eq=False)
class Burst:
    """Radiance, depth and cameras of the V views of a rig around an instant."""

    keys: Float32  # [k, V, H, W] radiance at k ticks, evenly from -REACH to REACH around the instant
    depth: Float32  # [V, H, W] metres along the optical axis at the instant, inf: nothing
    moving: Mask  # [V, H, W] stored for this instant: shows something that moves, its shadow, or is near
    w2c: Float64  # [V, 4, 4]
    K: Float64  # [V, 3, 3]
    gain: Float32  # [V, H, W] relative sensitivity
    dark: Float32  # [V, H, W] spikes per tick


@dataclass(frozen=True)
class BurstFile:
    """An open file of bursts."""

    path: Path
    facts: BurstFacts
    sha256: str  # of its tensors

    def __len__(self) -> int:
        """Return the number of bursts."""
        return self.facts.rigs * self.facts.instants + self.facts.resting

    def read(self, number: int) -> Burst:
        """Read the burst `number`, of all views, those at rest last. Raises UserError where the file is damaged."""
        f = self.facts
        moves = number < f.rigs * f.instants
        rig, instant = divmod(number, f.instants) if moves else (f.rigs + number - f.rigs * f.instants, 0)
        shape = (f.views, f.height, f.width)
        try:
            with safetensors.safe_open(self.path, framework="np") as file:
                background, depth, w2c, K = (
                    _part(file, name, rig, (f.rigs + f.resting, *sides))
                    for name, sides in (
                        ("still", shape),
                        ("still_depth", shape),
                        ("w2c", (f.views, 4, 4)),
                        ("K", (f.views, 3, 3)),
                    )
                )
                if moves:
                    parts = (file.get_tensor(f"{n}.{rig}.{instant}") for n in ("given", "values", "depth"))
                    given, values, there = parts
                else:
                    given, values, there = _NOTHING
                gain, dark = file.get_tensor("gain"), file.get_tensor("dark")
            if gain.shape != shape or dark.shape != shape or len(values) * math.prod(shape) > _MOST_VALUES:
                raise ValueError(f"maps of shape {gain.shape} and {dark.shape}, radiance at {len(values)} ticks")
            moving = np.zeros(shape, bool)
            if moves:
                moving = np.unpackbits(given, count=math.prod(shape)).astype(bool).reshape(shape)
            keys = np.repeat(background.astype(np.float32)[None], len(values), axis=0)
            keys[:, moving] = values
            depth = depth.astype(np.float32)
            depth[moving] = there
        except (safetensors.SafetensorError, OSError, ValueError, LookupError, TypeError) as e:
            raise problem(self.path, "training bursts", f"damaged data ({str(e)[:200]})", _FIX) from None
        return Burst(keys, depth, moving, w2c, K, gain.astype(np.float32), dark.astype(np.float32))


def _part(file: Any, name: str, index: int, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return one entry of a tensor of that shape. Raises ValueError for another shape."""
    part = file.get_slice(name)
    if tuple(part.get_shape()) != shape:
        raise ValueError(f"{name} of shape {part.get_shape()}, and not {shape}")
    found: NDArray[Any] = part[index]
    return found


def burst_path(folder: Path, world: str, variant: int) -> Path:
    """Return the path of a variant's file."""
    return folder / f"{world}-{variant}.safetensors"


def open_bursts(path: Path) -> BurstFile:
    """Open a file of bursts. Raises UserError where it is missing, damaged, or something else."""
    try:
        check_header(path)
        with safetensors.safe_open(path, framework="np") as file:
            meta = file.metadata() or {}
        if _SCHEMA not in meta:
            raise problem(path, f"metadata {_SCHEMA}", ", ".join(meta) or "none", "name a folder of make-msdi-data")
        fields: dict[str, Any] = parse_json(meta[_SCHEMA])
        digest = str(fields.pop("sha256"))
        return BurstFile(path, _checked(BurstFacts(**fields)), digest)
    except (safetensors.SafetensorError, OSError, LookupError, TypeError, ValueError, AttributeError) as e:
        raise problem(path, "training bursts", f"damaged data ({e})", _FIX) from None


def _checked(facts: BurstFacts) -> BurstFacts:
    """Return the facts. Raises ValueError for names that are none and for numbers out of bounds."""
    if not is_id(facts.world):
        raise ValueError(f"the world {shown(facts.world)}")
    for side in (facts.width, facts.height):
        whole(side, 1, MAX_SIDE)
    for count in (facts.views, facts.rigs, facts.instants):
        whole(count, 1, _MOST_VIEWS)
    whole(facts.spp, 1, 1 << 20)
    whole(facts.resting, 0, _MOST_VIEWS)
    for value in (facts.variant, facts.seed):
        whole(value, 0, 2**63)
    for gain in (facts.radiance_gain, facts.photons_per_spike):
        positive(gain, MAX_GAIN)
    return facts


def open_folder(folder: Path) -> list[BurstFile]:
    """Open all burst files of a folder, by world and variant. Raises UserError as `open_bursts`, and for no file."""
    files = [open_bursts(path) for path in sorted(folder.glob("*.safetensors"))]
    if not files:
        fix = "make some with `spike4dgs make-msdi-data`, or correct the path"
        raise problem(folder, "a folder of training bursts", "no *.safetensors file", fix)
    return sorted(files, key=lambda file: (file.facts.world, file.facts.variant))


def write_bursts(path: Path, facts: BurstFacts, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write a file atomically; equal arrays give equal bytes.

    Raises UserError for radiance that is not finite, and ValueError for arrays other than `stack_bursts` gives.
    """
    for name, array in arrays.items():
        if name.startswith(("still", "values")) and name != "still_depth" and not np.isfinite(array).all():
            found = f"{np.count_nonzero(~np.isfinite(array))} that are not in {name}"
            raise problem(path, "finite radiances", found, "correct the world or the renderer")
    # safetensors writes an array's memory as it lies, whatever its strides
    plain = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    digest = hashlib.sha256()
    for name in sorted(plain):
        digest.update(name.encode() + plain[name].tobytes())
    meta = json.dumps({**asdict(facts), "sha256": digest.hexdigest()}, sort_keys=True)
    with atomic_path(path) as part:
        safetensors.numpy.save_file(plain, part, metadata={_SCHEMA: meta})


def stack_bursts(
    rigs: Sequence[Sequence[Burst]], backgrounds: Sequence[tuple[Float32, Float32]], resting: Sequence[Burst] = ()
) -> Arrays:
    """Return the arrays of a file from the bursts of each rig, and each rig's `still` and `still_depth` [V, H, W].

    Where a burst is not `moving`, its keys and depth are not used. Gain and dark maps are the first burst's. The bursts
    of `resting` are of further rigs, and nothing moves in them: their first images are used.
    """
    most = 100.0  # radiance far beyond what saturates a sensor, within half floats
    first = rigs[0][0]
    still = [*backgrounds, *((burst.keys[0], burst.depth) for burst in resting)]
    firsts = [*(bursts[0] for bursts in rigs), *resting]
    arrays: Arrays = {
        "still": np.stack([np.minimum(radiance, most) for radiance, _ in still]).astype(np.float16),
        "still_depth": np.stack([_half(depth) for _, depth in still]),
        "w2c": np.stack([burst.w2c for burst in firsts]),
        "K": np.stack([burst.K for burst in firsts]),
        "gain": first.gain.astype(np.float16),
        "dark": first.dark.astype(np.float16),
    }
    for r, bursts in enumerate(rigs):
        for i, burst in enumerate(bursts):
            arrays[f"given.{r}.{i}"] = np.packbits(burst.moving)
            arrays[f"values.{r}.{i}"] = np.minimum(burst.keys[:, burst.moving], most).astype(np.float16)
            arrays[f"depth.{r}.{i}"] = _half(burst.depth[burst.moving])
    return arrays


def _half(depth: Float32) -> Half:
    with np.errstate(over="ignore"):  # beyond 65 km there is nothing
        return depth.astype(np.float16)
