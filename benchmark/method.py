"""The method protocol and the recipe: a method is four choices.

A method sees a `TrainingScene` and returns a model that renders a camera at a time. The runner, the judge and the
leaderboard know nothing else of it. Methods of other packages come in by the entry-point group `spike4dgs.methods`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene

GROUP = "spike4dgs.methods"


@dataclass(frozen=True)
class Recipe:
    """A method named by its four parts; `settings` overrides hyper-parameters of the trainer by name."""

    name: str
    images: str  # what image does a spike window give? tfi, tfp, ...
    initialization: str  # where are the cameras and the first points? rig, ...
    motion: str  # how do Gaussians move? static, hexplane, ...
    supervision: str  # what is compared with what? pixel, ...
    settings: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for the result record and the content key."""
        return {**asdict(self), "settings": dict(self.settings)}


SCALES = {"quick": 1.0, "standard": 4.0}  # quick: at most 90 s a fit on two cores, 200x125 pixels, 20 ms
PAPER = "paper"


@dataclass(frozen=True)
class Budget:
    """What a fit may spend. `scale` multiplies a recipe's step counts; with `published` they are its publication's."""

    scale: float = 1.0
    published: bool = False

    @property
    def label(self) -> float | str:
        """How records name it: the scale, or "paper"."""
        return PAPER if self.published else self.scale


def make_budget(text: str) -> Budget:
    """The budget that a command line names: quick, standard, paper, or a multiple of quick.

    Raises UserError for anything else.
    """
    if text == PAPER:
        return Budget(published=True)
    try:
        scale = SCALES[text] if text in SCALES else float(text)
    except ValueError:
        scale = 0.0
    if not 0 < scale < float("inf"):
        expected = f"{', '.join(SCALES)}, {PAPER}, or a positive number"
        raise problem("--budget", expected, repr(text), "use quick for a first look")
    return Budget(scale)


class Progress(Protocol):
    """Where a fit reports to: `done` of `total` steps and a short note such as the loss."""

    def __call__(self, done: int, total: int, note: str = "") -> None:
        """Report."""
        ...


class Model(Protocol):
    """A fitted scene. Two attributes may be added: `size_bytes`, what it takes on disk, without code, and `save`, which
    writes it (`provenance.Savable`): a run keeps what it can save."""

    def render(self, camera: Camera, t_us: float) -> NDArray[np.float32]:
        """Gray linear radiance [H, W] float32 (1.0 = white) seen by `camera` at the time `t_us`."""
        ...


class Method(Protocol):
    """Something that fits scenes. `params` is recorded and is part of the key under which a result is resumed.

    Three attributes may be added: `version` (the package's if absent; also part of the key), `trained_on`, the names
    of the data sets that learned parts have seen, and `refines_views`: its models have `refine` (see `refinement`).
    """

    name: str
    params: dict[str, Any]

    def fit(
        self,
        scene: TrainingScene,
        budget: Budget,
        device: str,
        seed: int,
        progress: Progress,
        checkpoint: Path | None = None,
    ) -> Model:
        """Fit the training views. With `checkpoint`, save progress to that file and resume from it if it exists."""
        ...


def find_methods() -> dict[str, Method]:
    """All methods of all installed packages, by name. Each entry point names a mapping from name to method.

    Raises UserError where two packages use one name, and where one cannot be imported.
    """
    methods: dict[str, Method] = {}
    for entry in sorted(entry_points(group=GROUP), key=lambda e: e.name):
        try:
            found = entry.load()
        except Exception as e:  # somebody else's package
            fix = "repair or uninstall the package that registers it"
            raise problem(f"entry point {entry.name}", entry.value, f"{type(e).__name__}: {e}", fix) from e
        for name, method in found.items():
            if name in methods:
                raise problem(f"entry point {entry.name}", "a new method name", f"'{name}' twice", "rename one of them")
            methods[name] = method
    return methods


def get_method(name: str) -> Method:
    """The method called `name`. Raises UserError that lists the known names."""
    methods = find_methods()
    if name not in methods:
        raise problem(
            "method", f"one of {', '.join(sorted(methods))}", repr(name), "see `spike4dgs run-benchmark --help`"
        )
    return methods[name]
