"""Methods that look for what a fit must not see, and one that writes down what it finds."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from dummy_methods import CountMethod
from numpy.typing import NDArray

from spike4dgs.benchmark.files import write_json
from spike4dgs.benchmark.method import FitRequest
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import open_stream
from spike4dgs.benchmark.weights import WeightsError


class PlaysBack:
    """Finds the held-out camera's stream next to those that it is given, and plays its spikes back."""

    def __init__(self, name: str = "plays-back") -> None:
        self.name = name
        self.params: dict[str, Any] = {}

    def fit(self, scene: TrainingScene, request: FitRequest) -> PlaysBack:
        first = scene.streams[0]
        known = {Path(s.source).name for s in scene.streams}
        (other,) = (p for p in Path(first.source).parent.glob("*.dat") if p.name not in known)
        self.stream = open_stream(other, first.width, first.height, first.rate_hz)
        self.gain = scene.radiance_gain
        return self

    def render(self, camera: Camera, t_us: float) -> NDArray[np.float32]:
        tick = round(t_us * self.stream.rate_hz * 1e-6)
        start, stop = max(0, tick - 10), min(self.stream.n_ticks, tick + 10)
        return (self.stream.counts(start, stop) / (stop - start) / self.gain).astype(np.float32)


class LooksAround(CountMethod):
    """Writes what a method can see without a search of the disk: its folder, the process, the scene, the request."""

    def __init__(self, report: Path, given: tuple[str, ...] = ("poses", "flat-field")) -> None:
        super().__init__("looks-around")
        self.given, self._report = given, report

    def fit(self, scene: TrainingScene, request: FitRequest) -> Any:
        files = {p.relative_to(Path()).as_posix(): p for p in Path().rglob("*") if p.is_file()}
        write_json(
            self._report,
            {
                "files": sorted(files),
                "links": sorted(name for name, p in files.items() if p.is_symlink()),
                "names": {name: p.stat().st_nlink for name, p in files.items()},
                "texts": {n: p.read_text() for n, p in files.items() if p.suffix in (".json", ".md")},
                "folder": os.getcwd(),
                "argv": sys.argv,
                "environment": dict(os.environ),
                "input": sys.stdin.read(),
                "scene": [scene.id, scene.revision, [s.source for s in scene.streams]],
                "recordings": [r is not None for r in scene.recordings],
                "cameras": [[c.id, *c.K.ravel().tolist(), *c.R.ravel().tolist(), *c.t.tolist()] for c in scene.cameras],
            },
        )
        print("printed to standard output")
        return super().fit(scene, request)


class Darker(CountMethod):
    """Makes darker images than its parameters say."""

    def fit(self, scene: TrainingScene, request: FitRequest) -> Any:
        model = super().fit(scene, request)
        model.image = 0.9 * model.image
        return model


class Refines(CountMethod):
    """Says when it saw the held-out view to refine by, and moves its camera: its second images are brighter."""

    refines_views = True

    def __init__(self, report: Path) -> None:
        super().__init__("refines")
        self._report = report

    def fit(self, scene: TrainingScene, request: FitRequest) -> Any:
        self.inner = super().fit(scene, request)
        self.fitted = time.monotonic()
        self.rendered: list[float] = []
        self.brightness = 1.0
        return self

    def render(self, camera: Camera, t_us: float) -> NDArray[np.float32]:
        self.rendered.append(float(camera.t[0]))
        return (self.brightness * self.inner.render(camera, t_us)).astype(np.float32)

    def refine(self, camera: Camera, image: NDArray[np.float32], background: NDArray[np.bool_], t_us: float) -> Camera:
        seen = {"before": len(self.rendered), "image": float(image.mean()), "background": int(background.sum())}
        self._report.write_text(json.dumps(seen))
        self.brightness = 1.25
        return camera

    def save(self, path: Path, provenance: Any) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"scene": provenance.scene, "revision": provenance.scene_revision}))


class Swaps(CountMethod):
    """Puts a link in the place of an image that it rendered."""

    def __init__(self, target: Path) -> None:
        super().__init__("swaps")
        self._target = target

    @property
    def size_bytes(self) -> int:
        """The size of the model."""
        return 1

    def fit(self, scene: TrainingScene, request: FitRequest) -> Any:
        assert request.checkpoint is not None
        self.inner, self._work = super().fit(scene, request), request.checkpoint.parent
        return self

    def render(self, camera: Camera, t_us: float) -> Any:
        if made := sorted(self._work.glob("images-0/*/*.exr")):
            made[0].unlink()
            made[0].symlink_to(self._target)
        return self.inner.render(camera, t_us)


class ReadsAndKeeps(CountMethod):
    """Reads a file by a path that it knows, keeps something for its next fit, and prints the errors, if any."""

    def __init__(self, path: Path, kept: Path) -> None:
        super().__init__("reads-and-keeps")
        self._path, self._kept = path, kept

    def fit(self, scene: TrainingScene, request: FitRequest) -> Any:
        for what, act in (("read", self._path.read_bytes), ("kept", lambda: self._kept.write_text("it"))):
            try:
                act()
                print(f"{what}: done")
            except OSError as e:
                print(f"{what}: {e.strerror}")
        return super().fit(scene, request)


class DiesBesideItsChild(CountMethod):
    """Dies while a child of its own, which holds its pipes, goes on."""

    def __init__(self, child: Path) -> None:
        super().__init__("dies")
        self._child = child

    def fit(self, scene: TrainingScene, request: FitRequest) -> Any:
        if (child := os.fork()) == 0:
            time.sleep(300)
            os._exit(0)
        self._child.write_text(str(child))
        os.kill(os.getpid(), signal.SIGKILL)


class LacksWeights(CountMethod):
    """Says that a file is not here."""

    def fit(self, scene: TrainingScene, request: FitRequest) -> Any:
        raise WeightsError("/somewhere/net.pth: expected weights, found no such file", "needs net.pth")
