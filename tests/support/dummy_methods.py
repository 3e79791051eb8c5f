"""Small real methods for tests of the runner, and the runner's settings around them."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from spike4dgs.benchmark.method import FitRequest
from spike4dgs.benchmark.runs.run import Settings, run_matrix
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene, open_scene


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
        rates = np.stack([s.counts(0, s.n_ticks) / s.n_ticks / scene.radiance_gain for s in scene.streams])
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


def run(out: Path, scenes: list[Path], *methods: Any, **settings: Any) -> list[dict[str, Any]]:
    with open(os.devnull, "w") as nothing:
        return run_matrix([open_scene(s) for s in scenes], methods, Settings(out, **settings), Console(file=nothing))


if __name__ == "__main__":  # a run that kills itself: OUT SCENE METHOD_THAT_DIES STEP
    out, scene, victim, step = sys.argv[1:]
    names = ("first", "second")
    run(Path(out), [Path(scene)], *(CountMethod(n, die_at=int(step) if n == victim else None) for n in names), seed=3)
