"""The initialisation part of a recipe, as a fit sees it: a request, a start, and what a fit takes of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.weights import FoundWeights
from spike4dgs.method.array_path import ArrayPath
from spike4dgs.method.images.base import Learned, learned_from
from spike4dgs.method.images.recorded import Recorded
from spike4dgs.method.models.network_weights import WeightKind
from spike4dgs.method.motion.base import Extent
from spike4dgs.method.settings import Settings
from spike4dgs.method.splat.types import NEAR

FARTHEST = 1e4  # x a scene's size from the origin: float32 resolves a thousandth of it there


@dataclass(frozen=True, eq=False)
class Start:
    """A pose for each training camera, and first points on surfaces."""

    cameras: tuple[Camera, ...]
    points: Float32  # [N, 3] m
    values: Float32  # [N] gray radiance
    path: ArrayPath | None = None  # by which the array moves through the world that the points are of; None: it stands


@dataclass(frozen=True, eq=False)
class StartRequest:
    """Everything that an initialisation may use."""

    scene: TrainingScene
    seed: int
    settings: Any  # the initialisation's own, as the recipe overrides them
    device: str = "cpu"  # of the fit
    recorded: Recorded | None = None  # images of other sensors, of recipes that take nothing of the spikes


@dataclass(frozen=True)
class Initialization:
    """An entry of the table of initialisations: the function, and the defaults of its settings.

    A setting `flat_field` follows the recipe's `images.flat_field` unless the recipe says otherwise.
    """

    start: Callable[[StartRequest], Start]
    settings: Settings = Settings()
    label: str | None = None  # in descriptions of recipes; None: the name
    estimates_poses: bool = False  # those given serve for nothing but the frame
    calibrated: bool = False  # takes the cameras' calibrations, whether `flat_field` or not
    from_recorded: bool = False  # takes images of other sensors where a recipe has some
    networks: tuple[WeightKind[Any], ...] = ()  # that it runs


def learned_facts(images: Learned | None, start: Sequence[WeightKind[Any]]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return what a method's parameters say of the weights of its images and of its start's networks, with their data.

    Of a start they name the weights in use in place of the included ones, as far as they can be read. The package's
    version names the included ones, which have seen nothing that is scored.
    """
    found = [(kind, learned_from(kind.in_use, kind.read_card)) for kind in start]
    others = [used for kind, used in found if used and used.sha256 != FoundWeights(kind.shipped).sha256]
    facts: dict[str, Any] = {"weights_sha256": images.sha256} if images else {}
    facts |= {"start_weights_sha256": [used.sha256 for used in others]} if others else {}
    seen = [name for used in (*([images] if images else ()), *others) for name in used.trained_on]
    return facts, tuple(dict.fromkeys(seen))


def at_most(count: int, start: Start, seed: int) -> tuple[Float32, Float32]:
    """Return the points [N, 3] and gray values [N] of a start, or a random choice of as many as a fit may have."""
    points, values = start.points, start.values
    if len(points) <= count:
        return points, values
    kept = np.sort(np.random.default_rng(seed).choice(len(points), count, replace=False))
    return points[kept], values[kept]


def measure(start: Start, scene: TrainingScene) -> Extent:
    """Return the scene's box and size, from the points seen and not only from the array, small beside the scene.

    The box holds 98 % of the points on each axis and a margin of a tenth. Size: the larger of 1.1 x the array's radius
    (3DGS) and half the points' median distance. Raises UserError where nothing would be rendered, as all is too near in
    the unit of the poses, or where they are so far from the origin that float32 does not resolve the scene.
    """
    centers = np.stack([c.center for c in start.cameras])
    middle = centers.mean(axis=0)
    low, high = np.quantile(start.points, [0.01, 0.99], axis=0)
    margin = 0.1 * (high - low) + 1e-3 * float((high - low).max())
    distance = float(np.median(np.linalg.norm(start.points - middle, axis=1)))
    scale = max(1.1 * float(np.linalg.norm(centers - middle, axis=1).max()), 0.5 * distance)
    depths = [float(np.median(c.project(start.points.astype(np.float64))[1])) for c in start.cameras]
    if max(depths) <= 2 * NEAR:
        expected = f"things farther than {2 * NEAR:g} m from the cameras"
        found = f"a median distance of {max(depths):.3g} m"
        raise problem(f"scene {scene.id}", expected, found, "give poses in metres: COLMAP's unit is arbitrary")
    if (away := float(np.abs(centers).max())) > FARTHEST * scale:
        expected = f"an origin near the scene, whose size is {scale:.3g} m"
        fix = "subtract the cameras' mean position from all poses"
        raise problem(f"scene {scene.id}", expected, f"cameras {away:.3g} m from it", fix)

    def tensor(a: NDArray[np.float64]) -> Tensor:
        return torch.as_tensor(a, dtype=torch.float32)

    return Extent(tensor(low - margin), tensor(high + margin), scale, scene.n_ticks, start.cameras[0].width)
