"""A world for tests that needs no renderer: a textured floor, a wall, and a board that moves in front of them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.method import Model
from spike4dgs.benchmark.scene.cameras import Camera, look_at
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack

RATE_HZ, GAIN = 20000.0, 0.6


def run_neurons(rate: NDArray[np.floating], charge: NDArray[np.floating], ticks: int) -> NDArray[np.float64]:
    """Spikes of integrate-and-fire neurons with subtractive reset, one tick after the other."""
    charge, spikes = charge.astype(np.float64), np.zeros(rate.shape)
    for _ in range(ticks):
        charge += rate
        fired = charge >= 1
        charge -= fired
        spikes += fired
    return spikes


def few_views(scene: TrainingScene, *chosen: int) -> TrainingScene:
    """Return a scene of some of its views."""
    names = ("cameras", "streams", *(["recordings"] if scene.recordings else []))
    return replace(scene, **{name: tuple(getattr(scene, name)[i] for i in chosen) for name in names})


@dataclass(frozen=True)
class ToyWorld:
    """A square array of cameras 4 m in front of a wall; the board between moves `travel` m to the right in the clip."""

    width: int = 64
    height: int = 40
    side: int = 3  # cameras per side of the array
    n_ticks: int = 240
    travel: float = 0.25
    seed: int = 0
    lens: tuple[float, ...] = ()  # of every camera
    spread: float = 0.0  # of the cameras' focal lengths, and of their principal points in image widths
    views: tuple[int, ...] = ()  # those of all cameras but the centre one that record the training scene; all if empty

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        offsets, cameras = np.linspace(-0.4, 0.4, self.side), []
        target, up = np.array([0.0, 0.3, 0.7]), np.array([0.0, 0.0, 1.0])
        for i, (z, x) in enumerate((z, x) for z in offsets for x in offsets):
            focal = 1.2 * self.width * (1 + self.spread * (i % 4 - 1.5))
            size = {"focal": focal, "width": self.width, "height": self.height}
            camera = look_at(f"cam_{i:02d}", np.array([x, -3.0, 1.0 + z]), target, up, **size)
            cx = self.width * (0.5 + self.spread * (i % 3 - 1))
            cameras.append(replace(camera, distortion=self.lens, cx=cx))
        return tuple(cameras)

    def texture(self, surface: int, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        """Band-limited gray pattern of a surface at its coordinates (a, b) in metres."""
        rng = np.random.default_rng([self.seed, surface])
        finest = 0.9 * 1.2 * self.width / 3.5  # rad/m that are 0.9 rad/px at 3.5 m
        total = np.zeros_like(a)
        for _ in range(12):
            k = rng.uniform(0.15, 1) * finest * np.array([np.cos(p := rng.uniform(0, 6.28)), np.sin(p)])
            total += np.sin(k[0] * a + k[1] * b + rng.uniform(0, 6.28))
        return 0.45 + 0.35 * np.tanh(total / 2.5)

    def trace(self, camera: Camera, t: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Radiance, depth z and board mask, each [H, W], at t in [0, 1]."""
        if self._last.get("camera") is not camera:
            self._last.update(camera=camera, background=self._background(camera))
        return self._with_board(self._last["background"], t)

    @cached_property
    def _last(self) -> dict[str, Any]:
        """The camera that was traced last, and its background: a stream traces one camera at many times."""
        return {}

    def _background(self, camera: Camera) -> tuple[NDArray[np.float64], ...]:
        """Radiance and depth without the board, depth of its plane and the points [H, W, 3] there."""
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        xy = camera.normalized(np.stack([u, v], -1))
        d = np.concatenate([xy, np.ones_like(xy[..., :1])], -1) @ camera.R
        o = camera.center
        with np.errstate(divide="ignore", invalid="ignore"):
            to_floor, to_wall, to_board = -o[2] / d[..., 2], (1.0 - o[1]) / d[..., 1], -o[1] / d[..., 1]
        floor, wall, board = (o + s[..., None] * d for s in (to_floor, to_wall, to_board))
        on_floor = (to_floor > 0) & (to_floor < to_wall)
        image = np.where(
            on_floor, self.texture(0, floor[..., 0], floor[..., 1]), self.texture(1, wall[..., 0], wall[..., 2])
        )
        return image, np.where(on_floor, to_floor, to_wall), to_board, board

    def _with_board(
        self, background: tuple[NDArray[np.float64], ...], t: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        image, depth, to_board, board = background
        x = board[..., 0] - self.travel * (t - 0.5)
        on_board = (np.abs(x) < 0.45) & (np.abs(board[..., 2] - 0.6) < 0.35)
        image = image.copy()
        image[on_board] = self.texture(2, x[on_board], board[..., 2][on_board])
        return image, np.where(on_board, to_board, depth), on_board

    def stream(self, camera: Camera, index: int) -> SpikeStream:
        """Noise-free integrate-and-fire of the radiance, which is traced every 8 ticks and interpolated."""
        keys = np.arange(0, self.n_ticks + 8, 8)
        frames = np.stack([self.trace(camera, k / self.n_ticks)[0] for k in keys])
        charge = np.random.default_rng([self.seed, 100 + index]).random(frames.shape[1:])
        packed = []
        for tick in range(self.n_ticks):
            i, w = divmod(tick + 0.5, 8)
            charge += GAIN * ((1 - w / 8) * frames[int(i)] + w / 8 * frames[int(i) + 1])
            fired = charge >= 1
            charge -= fired
            packed.append(pack(fired[None]))
        return SpikeStream(np.concatenate(packed), self.width, self.height, RATE_HZ)

    def surfaces(
        self, cameras: Sequence[Camera], noise_m: float, seed: int = 0
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Noisy points [n, 3] on what `cameras` see at the middle of the clip, a point for 2x2 pixels; values [n]."""
        rng, points, values = np.random.default_rng(seed), [], []
        for camera in cameras:
            image, depth, _ = self.trace(camera, 0.5)
            v, u = np.mgrid[0 : camera.height : 2, 0 : camera.width : 2].reshape(2, -1)
            points.append(camera.unproject(np.stack([u, v], -1) + 0.5, depth[v, u]))
            values.append(image[v, u])
        cloud = np.concatenate(points)
        cloud += noise_m * rng.normal(size=cloud.shape)
        return cloud.astype(np.float32), np.concatenate(values).astype(np.float32)

    def depth_errors(self, points: NDArray[np.floating], camera: Camera | None = None) -> NDArray[np.float64]:
        """Relative errors of the depths of what a camera, or the held-out one, sees of points, at the middle."""
        camera = camera or self.held_out
        uv, z = camera.project(points.astype(np.float64))
        u, v = np.floor(uv).astype(int).T
        seen = (z > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        return np.abs(z[seen] / self.trace(camera, 0.5)[1][v[seen], u[seen]] - 1)

    def psnr(self, model: Model, moving: bool) -> float:
        """Mean over the clip, dB, of the centre camera: everywhere, or on the board only."""
        error = []
        for t in np.linspace(0.1, 0.9, 5):
            truth, _, board = self.trace(self.held_out, t)
            squared = (model.render(self.held_out, t * self.training.duration_us) - truth) ** 2
            error.append(squared[board].mean() if moving else squared.mean())
        return float(-10 * np.log10(error).mean())

    @cached_property
    def held_out(self) -> Camera:
        """The centre camera."""
        return self.cameras[len(self.cameras) // 2]

    @cached_property
    def training(self) -> TrainingScene:
        """All cameras but the centre one, or `views` of them: what works on pairs takes the square of their number."""
        chosen = [(i, c) for i, c in enumerate(self.cameras) if c is not self.held_out]
        chosen = [chosen[k] for k in self.views] or chosen
        streams = tuple(self.stream(c, i) for i, c in chosen)
        cameras = tuple(c for _, c in chosen)
        return TrainingScene("toy", f"toy-{self!r}", cameras, streams, RATE_HZ, self.n_ticks, GAIN)
