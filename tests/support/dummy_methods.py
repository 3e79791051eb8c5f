"""Small real methods for tests of the runner, and the runner's settings around them."""

import json
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from spike4dgs.benchmark.method import FitRequest
from spike4dgs.benchmark.runs.run import Settings, run_matrix
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene, open_scene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.weights import WeightsError


def mean_rate(stream: SpikeStream) -> NDArray[np.float64]:
    """Return the spikes a tick of each pixel, without numba, whose import and kernels take a process a second."""
    shape = stream.height, stream.width
    spikes = np.unpackbits(stream.packed, axis=1, count=shape[0] * shape[1], bitorder="little")
    rate = spikes.sum(axis=0).reshape(shape) / stream.n_ticks
    return rate[::-1] if stream.rows_bottom_up else rate


class CountModel:
    """A weighted sum of the training views' mean rates, moved a little with time."""

    def __init__(self, weights: NDArray[np.float64], rates: NDArray[np.float64]) -> None:
        self.image = np.tensordot(weights, rates, 1)

    def render(self, camera: Camera, t_us: float) -> NDArray[np.float32]:
        assert self.image.shape == (camera.height, camera.width)
        return (self.image + 1e-6 * t_us).astype(np.float32)


class CountMethod:
    """Steps towards equal weights of the training views, with a checkpoint after every step."""

    def __init__(self, name: str = "counts", steps: int = 4, die_at: int | None = None, **params: Any) -> None:
        self.name = name
        self.params: dict[str, Any] = {"steps": steps, **params}
        self._die_at = die_at
        self.fits = 0

    def fit(self, scene: TrainingScene, request: FitRequest) -> CountModel:
        self.fits += 1
        checkpoint = request.checkpoint
        rates = np.stack([mean_rate(stream) / scene.radiance_gain for stream in scene.streams])
        weights, first = np.random.default_rng(request.seed).random(len(rates)), 0
        if checkpoint and checkpoint.exists():
            state = json.loads(checkpoint.read_text())
            weights, first = np.array(state["weights"]), state["step"]
        for step in range(first, self.params["steps"]):
            if step == self._die_at:
                os.kill(os.getpid(), signal.SIGKILL)
            weights = weights + 0.5 * request.budget.scale * (1 / len(rates) - weights)
            if checkpoint:
                checkpoint.write_text(json.dumps({"weights": weights.tolist(), "step": step + 1}))
            request.progress(step + 1, self.params["steps"], f"step {step}")
        return CountModel(weights, rates)


class WorkerKiller(CountMethod):
    """Kills its process after two steps, once for each file in a folder. Notes the step at which each fit begins."""

    def __init__(self, name: str, folder: Path) -> None:
        super().__init__(name)
        self._folder = folder

    def fit(self, scene: TrainingScene, request: FitRequest) -> CountModel:
        with open(self._folder / "begins.txt", "a") as f:
            saved = request.checkpoint and request.checkpoint.exists() and json.loads(request.checkpoint.read_text())
            f.write(f"{saved['step'] if saved else 0}\n")
        bullets = sorted(self._folder.glob("bullet*"))
        self._die_at = 2 if bullets else None
        for bullet in bullets[:1]:
            bullet.unlink()
        return super().fit(scene, request)


class WaitingMethod(CountMethod):
    """Begins to fit, says so by a file, and goes on once another file is there."""

    def __init__(self, name: str, folder: Path) -> None:
        super().__init__(name)
        self._folder = folder

    def fit(self, scene: TrainingScene, request: FitRequest) -> CountModel:
        (self._folder / "begun").touch()
        wait_for(lambda: (self._folder / "go").exists())
        return super().fit(scene, request)


def wait_for(condition: Callable[[], Any], seconds: float = 120) -> None:
    """Return when a condition holds; an error after `seconds`."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"nothing after {seconds} s")
        time.sleep(0.05)


class FailingMethod(CountMethod):
    """Fails in a way of its choice."""

    def __init__(self, name: str, result: Any) -> None:
        super().__init__(name)
        self._result = result

    def fit(self, *args: Any, **kwargs: Any) -> Any:
        if isinstance(self._result, Exception):
            raise self._result
        return self

    def render(self, camera: Camera, t_us: float) -> Any:
        return self._result


class WeightlessMethod(CountMethod):
    """Lacks the weights that it would fit with."""

    def fit(self, scene: TrainingScene, request: FitRequest) -> CountModel:
        raise WeightsError("net.safetensors: expected weights, found no such file; fetch them", "no weights")


# Also the state of the checkout, which somebody may change while the tests run.
TIMINGS = ("fit_seconds", "render_fps", "peak_memory_mb", "fitted_with")


def without_timings(record: dict[str, Any]) -> dict[str, Any]:
    """Return what two runs of the same cells share."""
    cells = {s: {k: v for k, v in c.items() if k not in TIMINGS} for s, c in record["scenes"].items()}
    return {**record, "scenes": cells, "created": None, "command": None, "harness": None}


def prediction_bytes(out: Path) -> dict[str, bytes]:
    """Return the predictions of a run, of all its seeds, without what tells of times."""
    paths = sorted(p for p in out.rglob("*") if "predictions" in p.relative_to(out).parts)
    return {p.relative_to(out).as_posix(): p.read_bytes() for p in paths if p.is_file() and p.suffix != ".json"}


def run(out: Path, scenes: list[Path], *methods: Any, **settings: Any) -> list[dict[str, Any]]:
    with open(os.devnull, "w") as nothing:
        return run_matrix([open_scene(s) for s in scenes], methods, Settings(out, **settings), Console(file=nothing))


if __name__ == "__main__":  # a run that kills itself: OUT SCENE METHOD_THAT_DIES STEP
    out, scene, victim, step = sys.argv[1:]
    names = ("first", "second")
    methods = (CountMethod(n, die_at=int(step) if n == victim else None) for n in names)
    run(Path(out), [Path(scene)], *methods, seed=3, metrics=("psnr",))
