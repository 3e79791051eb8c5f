"""A method from another package: the scene as one plane, on which the two nearest training cameras' images meet."""

import cv2
import numpy as np


def make_image(scene, index, first, last):
    """Return linear radiance [H, W] that a training camera saw in ticks [first, last)."""
    counts = scene.streams[index].counts(first, last)
    return counts.astype(np.float32) / np.float32((last - first) * scene.radiance_gain)


def warp(image, source, camera, distance):
    """Return the image of `source` as `camera` would see it, if all were on the plane z = `distance` of `camera`."""
    R = source.R @ camera.R.T
    T = source.t - R @ camera.t
    H = source.K @ (R + np.outer(T, [0, 0, 1 / distance])) @ np.linalg.inv(camera.K)
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV's pixel centres are at whole numbers, ours at +0.5
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = (camera.width, camera.height)
    return cv2.warpPerspective(
        image, np.linalg.inv(half) @ H @ half, size, flags=flags, borderMode=cv2.BORDER_REPLICATE
    )


class PlaneBlendModel:
    """The fitted model: the benchmark asks it for the held-out views."""

    def __init__(self, scene, distance, half_window):
        self.scene, self.distance, self.half_window = scene, distance, half_window

    def render(self, camera, t_us):
        """Return linear radiance [H, W] float32 of `camera` at the time `t_us`."""
        tick, cameras = self.scene.tick(t_us), self.scene.cameras
        first, last = max(0, tick - self.half_window), min(self.scene.n_ticks, tick + self.half_window)
        away = np.array([np.linalg.norm(c.center - camera.center) for c in cameras])
        nearest = np.argsort(away, kind="stable")[:2]
        pair = [warp(make_image(self.scene, i, first, last), cameras[i], camera, self.distance) for i in nearest]
        return np.average(pair, axis=0, weights=1 / (away[nearest] + 1e-9)).astype(np.float32)


class PlaneBlend:
    """Fits one number: the distance at which the training cameras' mean images agree best."""

    name = "plane-blend"
    version = "0.1.0"
    params = {"planes": 24, "half_window_ticks": 20}  # recorded, and part of the key that a run resumes by

    def fit(self, scene, request):
        """Sweep planes around the cameras' common point, compare the first camera with all others, return the model."""
        across = [np.eye(3) - np.outer(c.R[2], c.R[2]) for c in scene.cameras]
        towards = [a @ c.center for a, c in zip(across, scene.cameras, strict=True)]
        meeting = np.linalg.lstsq(sum(across), sum(towards), rcond=None)[0]
        means = [make_image(scene, i, 0, scene.n_ticks) for i in range(len(scene.cameras))]
        first, *others = scene.cameras
        distances = (first.R @ meeting + first.t)[2] * np.geomspace(0.5, 2, self.params["planes"])
        errors = []
        for distance in distances:
            seen = [warp(mean, camera, first, distance) for mean, camera in zip(means[1:], others, strict=True)]
            errors.append(np.mean(np.abs(np.array(seen) - means[0])))
            request.progress(len(errors), len(distances), f"difference {errors[-1]:.4f}")
        return PlaneBlendModel(scene, distances[int(np.argmin(errors))], self.params["half_window_ticks"])


METHODS = {"plane-blend": PlaneBlend()}
