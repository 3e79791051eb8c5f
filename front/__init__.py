"""Spike4DGS: an open benchmark and reference method for 4D reconstruction from arrays of spike cameras.

The names of everyday work; each room (`spike4dgs.benchmark`, `.method`, `.baselines`, `.generators`, `.leaderboard`)
has more. Nothing is imported before it is used.

>>> import spike4dgs
>>> scene = spike4dgs.open_scene("data/car-0-tiny")
>>> scene
<Scene car-0-tiny: 4 cameras of 64x40 pixels, 80 ticks at 20000 Hz (4 ms); split center: ...>
>>> spikes = spike4dgs.open_stream("data/car-0-tiny/spikes/cam_00.dat", 64, 40, 20_000)
>>> image = spike4dgs.make_image("tfi", spikes, tick=40, gain=scene.radiance_gain)
>>> target = scene.targets[0]
>>> f"{spike4dgs.score_image(scene.ground_truth(target), image)['psnr']:.0f} dB"  # of another camera
'... dB'

A method fits the training cameras; `fit` shows its progress in a terminal and in a notebook:

>>> method = spike4dgs.find_methods()["nearest-view"]
>>> model = method.fit(scene.training, spike4dgs.FitRequest())

Any program's images become predictions that can be scored:

>>> images = {t: model.render(scene.cameras[t.camera], scene.t_us(t.tick)) for t in scene.targets}
>>> folder = spike4dgs.write_predictions("runs/mine", scene, images, "my-method")
>>> spike4dgs.score_predictions(folder, [scene])
<Record my-method: 1 scene, psnr ...>

What a run left is read back:

>>> record = spike4dgs.read_record("runs/tiny/results/tfp+static.json")
>>> spike4dgs.load_model("runs/tiny/models/tfp+static/car-0-tiny.safetensors")
<SavedModel tfp+static on car-0-tiny: ...>
"""

import importlib
from typing import TYPE_CHECKING, Any

from spike4dgs.benchmark.lazy import lazy_names

if TYPE_CHECKING:
    from spike4dgs.baselines.images.table import make_image
    from spike4dgs.benchmark.method import FitRequest, find_methods
    from spike4dgs.benchmark.metrics.measure import score_image
    from spike4dgs.benchmark.runs.predictions import write_predictions
    from spike4dgs.benchmark.runs.record import read_record
    from spike4dgs.benchmark.runs.score import score_predictions
    from spike4dgs.benchmark.scene.scene import open_scene
    from spike4dgs.benchmark.spikes.stream import open_stream
    from spike4dgs.method.models.saved_model import load_model

    __version__: str
else:
    _name, _names = lazy_names(
        __name__,
        {
            "baselines.images.table": ("make_image",),
            "benchmark.method": ("FitRequest", "find_methods"),
            "benchmark.metrics.measure": ("score_image",),
            "benchmark.runs.predictions": ("write_predictions",),
            "benchmark.runs.record": ("read_record",),
            "benchmark.runs.score": ("score_predictions",),
            "benchmark.scene.scene": ("open_scene",),
            "benchmark.spikes.stream": ("open_stream",),
            "method.models.saved_model": ("load_model",),
        },
    )
    _ROOMS = ("baselines", "benchmark", "generators", "leaderboard", "method")

    def __getattr__(name: str) -> Any:
        if name in _ROOMS:
            return importlib.import_module(f"{__name__}.{name}")
        if name == "__version__":
            from importlib.metadata import version

            return version(__name__)
        return _name(name)

    def __dir__() -> list[str]:
        return [*__all__, *_ROOMS, "__doc__", "__version__"]


__all__ = [
    "FitRequest",
    "find_methods",
    "load_model",
    "make_image",
    "open_scene",
    "open_stream",
    "read_record",
    "score_image",
    "score_predictions",
    "write_predictions",
]
