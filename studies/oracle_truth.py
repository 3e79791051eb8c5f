"""The truth of a made scene that oracles are given, as files: rendered again, at its training cameras, from its world.

    FOLDER/images/000120.npz   the training cameras' images at a tick: images [C, H, W], linear radiance
    FOLDER/surfaces.npz        what they see, at the middle of the clip: points [N, 3] m, values [N] gray radiance,
                               velocities [N, 3] m/s
    FOLDER/sensors.npz         each camera's maps: gain [C, H, W], mean 1, and dark [C, H, W], spikes per tick

FOLDER belongs to one scene, revision and number of samples. Nothing of a held-out camera is in it. The world, the seed
and the sampling are those that scene.json records; random numbers are others than those of the scene, so that no fit
sees the noise of the truth that judges it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.method import Progress
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.benchmark.untrusted import Expected, read_npz
from spike4dgs.generators.profiles import RATE_HZ, Job
from spike4dgs.generators.render_tasks import cameras_of, recorded_job, renderer_of, world_of
from spike4dgs.generators.rendering.keyframes import read_arrays, write_arrays
from spike4dgs.generators.rendering.render import MultiViewRenderer, StaticViews
from spike4dgs.generators.streams import sensor_of

Arrays = dict[str, np.ndarray]
_AGAIN = "delete it and run the same command again"


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Points [N, 3] m on surfaces at the middle of the clip, with their gray radiance [N] and velocity [N, 3] m/s."""

    points: Float32
    values: Float32
    velocities: Float32


@dataclass(frozen=True)
class Truth:
    """The truth in a folder. Reading raises UserError where a file is missing or damaged."""

    folder: Path

    @staticmethod
    def of(root: Path, scene: str, revision: str, samples: int) -> Truth:
        """Return the truth of a scene, its images of so many samples a pixel, below the folder of a run's truths."""
        return Truth(root / f"{scene}@{revision[:12]}-{samples}")

    def image_file(self, tick: int) -> Path:
        """Return the file of the images at a tick."""
        return self.folder / "images" / f"{tick:06d}.npz"

    @property
    def surfaces_file(self) -> Path:
        """The file of the points."""
        return self.folder / "surfaces.npz"

    @property
    def sensors_file(self) -> Path:
        """The file of the cameras' maps."""
        return self.folder / "sensors.npz"

    def images(self, ticks: Sequence[int]) -> Float32:
        """Return the training cameras' images [T, C, H, W] at ticks, linear radiance."""
        shape = {"images": Expected("f", (None, None, None))}
        return np.stack([read_npz(self.image_file(t), "true images", shape, _AGAIN)["images"] for t in ticks])

    def surfaces(self) -> Surfaces:
        """Return the points on surfaces."""
        shapes = {"points": Expected("f", (None, 3)), "values": Expected("f", (None,))}
        shapes["velocities"] = Expected("f", (None, 3))
        return Surfaces(**read_npz(self.surfaces_file, "true points", shapes, _AGAIN))

    def calibrations(self, radiance_gain: float) -> tuple[Calibration, ...]:
        """Return the response of each training camera to light; `radiance_gain`: spikes per tick of white."""
        shapes = dict.fromkeys(("gain", "dark"), Expected("f", (None, None, None)))
        maps = read_npz(self.sensors_file, "true gain and dark maps", shapes, _AGAIN)
        return tuple(Calibration(gain, dark, radiance_gain) for gain, dark in zip(*maps.values(), strict=True))


_SEED = 4_000_037  # added to a scene's seed: far from those of its own files and of second renderings
_SAME_POSE = 1e-6  # of rotations, and of metres and pixels beside one: the file's decimals


class WorldTruth:
    """The truth of one made scene, which can be rendered."""

    def __init__(self, job: Job, cameras: Sequence[Camera]) -> None:
        self.job, self.cameras = job, tuple(cameras)

    def write(self, truth: Truth, ticks: Sequence[int], samples: int, progress: Progress) -> None:
        """Render what `truth` lacks: the images at `ticks`, the points, the maps. A killed call resumes.

        Raises UserError for a number of samples that is no power of two.
        """
        if samples < 1 or samples & (samples - 1):
            raise problem("--samples", "a power of two", str(samples), "give 64, 128, 256, ...")
        write_arrays(truth.sensors_file, self.maps())
        missing = [t for t in ticks if not truth.image_file(t).is_file()]
        if not missing and truth.surfaces_file.is_file():
            return
        progress(0, len(missing) + 1, "background")
        kept = truth.folder / "background.npz"
        if not kept.is_file():
            write_arrays(kept, self.renderer(self.cameras, samples).static.arrays())
        static = StaticViews.from_arrays(read_arrays(kept))
        renderer = self.renderer(self.cameras, samples, static)
        if not truth.surfaces_file.is_file():
            write_arrays(truth.surfaces_file, surfaces(renderer, self.job.n_ticks, ticks))
        for done, tick in enumerate(missing, start=1):
            progress(done, len(missing) + 1, f"tick {tick}")
            write_arrays(truth.image_file(tick), {"images": renderer.keys(tick / RATE_HZ)})

    def renderer(self, cameras: Sequence[Camera], samples: int, static: StaticViews | None = None) -> MultiViewRenderer:
        """Return a renderer of the scene's truth as `cameras` see it, with random numbers of its own."""
        background = max(self.job.profile.background_spp, samples)
        own = {"seed": self.job.seed + _SEED, "spp": samples, "background_spp": background, "color": False}
        renderer = renderer_of(self.job, cameras, truth=True, static=static, **own)
        assert isinstance(renderer, MultiViewRenderer)  # `find_truth` refuses arrays that move
        return renderer

    def maps(self) -> Arrays:
        """Return gain and dark rate [C, H, W] of the cameras' sensors."""
        shape = self.cameras[0].height, self.cameras[0].width
        sensors = [sensor_of(self.job, camera) for camera in self.cameras]
        gains = [np.ones(shape, np.float32) if s.gain is None else s.gain for s in sensors]
        darks = [np.zeros(shape, np.float32) if s.dark is None else s.dark for s in sensors]
        return {"gain": np.stack(gains), "dark": np.stack(darks)}


def find_truth(scene: Scene) -> WorldTruth:
    """Return the truth of a scene at the training cameras of its split.

    Raises UserError where no world of this installation made the scene, where its cameras are others than the world's,
    and where they or the light move with time, which the renderings here do not.
    """
    fix = "make the scene with `spike4dgs make-dataset`"
    if (job := recorded_job(scene.meta["source"], scene.root)) is None:
        source = scene.meta["source"]
        raise problem(scene.root, "a scene whose world is here, for oracles", f"source {source.get('kind')!r}", fix)
    if job.physics.moves_array or job.flicker or world_of(job).flash:
        expected = "an array at rest in steady light, for oracles"
        raise problem(scene.root, expected, "another", "use a scene without array motion, flicker and flash")
    made = {camera.id: camera for camera in cameras_of(job)}
    cameras = [made[c] for c in scene.train if c in made and _alike(made[c], scene.cameras[c])]
    if len(cameras) < len(scene.train):
        raise problem(scene.root, "the cameras of its world, for oracles", "others", fix)
    return WorldTruth(job, cameras)


def _alike(a: Camera, b: Camera) -> bool:
    """Return whether two cameras are the same but for the rounding of a file."""

    def facts(c: Camera) -> np.ndarray:
        return np.concatenate([c.w2c.ravel(), c.K.ravel(), np.append(c.distortion, np.zeros(5))[:5]])

    same_size = (a.width, a.height) == (b.width, b.height)
    return same_size and bool(np.allclose(facts(a), facts(b), rtol=_SAME_POSE, atol=_SAME_POSE))


def surfaces(renderer: MultiViewRenderer, n_ticks: int, ticks: Sequence[int]) -> Arrays:
    """Return points [N, 3] m on what the views see, their radiance [N] and velocities [N, 3] m/s, all float32.

    One point for each pixel: of what moves, where it is in the middle of the clip; of what is static, also where it is
    hidden then, but not at the first or the last tick.
    """
    middle = n_ticks // 2 / RATE_HZ
    image, moving = renderer.keys(middle), renderer.object_masks(middle)
    depth, velocity = renderer.depths(middle), renderer.velocities(middle)
    uncovered = ~moving
    for tick in (ticks[0], ticks[-1]):
        uncovered |= ~renderer.object_masks(tick / RATE_HZ)
    rest = renderer.static_depths()
    value = np.where(moving, renderer.background, image)  # of what is static
    found = [
        (_lift(renderer.cameras, depth, moving), image[moving], velocity[moving]),
        (_lift(renderer.cameras, rest, seen := uncovered & np.isfinite(rest)), value[seen], 0 * velocity[seen]),
    ]
    points, values, velocities = (np.concatenate(parts).astype(np.float32) for parts in zip(*found, strict=True))
    return {"points": points, "values": values, "velocities": velocities}


def _lift(cameras: Sequence[Camera], depths: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the world points [N, 3] at the centres of the chosen pixels [C, H, W], in the order of the mask."""
    points = []
    for camera, depth, mask in zip(cameras, depths, chosen, strict=True):
        v, u = np.nonzero(mask)
        centres = np.stack([u, v], axis=1).astype(np.float64) + 0.5
        points.append(camera.unproject(centres, depth[mask].astype(np.float64)))
    return np.concatenate(points)
