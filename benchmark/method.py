"""The method protocol and the recipe: a method is four choices.

A method gets a `TrainingScene` and a `FitRequest`, and returns a model that renders a camera at a time. The runner, the
judge and the leaderboard know nothing else of it. Methods of other packages come in by the entry-point group
`spike4dgs.methods`.

A recipe overrides the numbers of its parts by name, PART.NAME:

    Recipe("tfp+4dgs, half the images", "tfp", "rig", "hexplane", "pixel",
           {"images.time_spacing_ticks": 20, "motion.lr_grid": 5e-3, "trainer.fine_steps": 900})
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.errors import problem, unknown
from spike4dgs.benchmark.json_values.text import parse_json
from spike4dgs.benchmark.plugins import Plugin, find_plugins
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.screen.fit_progress import FitProgress
from spike4dgs.benchmark.screen.shown import Table

GROUP = "spike4dgs.methods"
# What a method may be given beside streams, clock and intrinsics: the rig's poses, calibration recordings, the true
# points of sparse/0, the recordings of frame cameras and event cameras at the same positions.
GIVEN = ("poses", "flat-field", "points", "frames", "events")
DEFAULT_GIVEN = GIVEN[:2]  # what a method is given that says nothing


@dataclass(frozen=True)
class Recipe:
    """A method named by its four parts; `settings` overrides the parts' hyper-parameters, by names PART.NAME."""

    name: str
    images: str  # from spikes: tfi, tfp, ...
    initialization: str  # of cameras and first points: rig, ...
    motion: str  # of the Gaussians: static, hexplane, ...
    supervision: str  # the loss: pixel, ...
    settings: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for the result record and the content key."""
        return {**asdict(self), "settings": dict(self.settings)}


DEFAULT_BUDGET = "quick"
SCALES = {"quick": 1.0, "standard": 4.0}  # quick: at most 90 s a fit on two cores, 200x125 pixels, 20 ms
PAPER = "paper"
MAX_BUDGET = 1e6  # as in common.schema.json
MAX_SETTINGS = 100  # characters of the settings in a name, as in common.schema.json


@dataclass(frozen=True)
class Budget:
    """Steps of a fit. `scale` multiplies a recipe's step counts; with `published` they are its publication's."""

    scale: float = 1.0
    published: bool = False

    @property
    def label(self) -> float | str:
        """The name in records: the scale, or "paper"."""
        return PAPER if self.published else self.scale


def make_budget(text: str) -> Budget:
    """Return the budget that a command line names: quick, standard, paper, or a multiple of quick.

    Raises UserError for anything else.
    """
    if text == PAPER:
        return Budget(published=True)
    try:
        scale = SCALES[text] if text in SCALES else float(text)
    except ValueError:
        scale = 0.0
    if not 0 < scale <= MAX_BUDGET:
        expected = f"{', '.join(SCALES)}, {PAPER}, or a positive number, {MAX_BUDGET:g} at most"
        raise problem("--budget", expected, repr(text), "use quick for a first look")
    return Budget(scale)


class Progress(Protocol):
    """A receiver of a fit's progress: `done` of `total` steps and a short note such as the loss."""

    def __call__(self, done: int, total: int, note: str = "") -> None:
        """Report."""
        ...


def no_progress(done: int, total: int, note: str = "") -> None:
    """Report to nobody."""


@dataclass(frozen=True)
class FitRequest:
    """Everything that a fit is asked for beside the scene. A new field has a default, so that methods need not change.

    `checkpoint` is a file to save progress to, and to resume from if it exists; a method may ignore it.
    """

    budget: Budget = Budget()
    device: str = "cpu"  # as torch names it: cpu, cuda, cuda:1
    seed: int = 0
    progress: Progress = field(
        default_factory=FitProgress, compare=False, repr=False
    )  # shown in a terminal or notebook
    checkpoint: Path | None = None


class Model(Protocol):
    """A fitted scene. Two attributes may be added: `size_bytes`, its size on disk, without code, and `save`, which
    writes it (`provenance.Savable`): a run keeps the models that it can save."""

    def render(self, camera: Camera, t_us: float) -> NDArray[np.float32]:
        """Return gray linear radiance [camera.height, camera.width] float32, 1.0 = white, at the time `t_us`."""
        ...


class Method(Protocol):
    """Something that fits scenes. `params` is recorded and is part of the key under which a result is resumed.

    Nine attributes may be added: `version` (the package's if absent; also part of the key), `trained_on`, the names of
    the data sets that learned parts have seen, `given`, which of `GIVEN` it uses (`DEFAULT_GIVEN` if absent; tracks of
    the leaderboard withhold some), `refines_views`: its models have `refine` (see `refinement`), `description`, one
    line for `spike4dgs methods`, `warm_up(request)`, which compiles what `fit` runs and is called before the clock of a
    fit starts, `rasterizes`: False lets it run on a GPU without numba-cuda, `oracle`: what the truth replaces in it (no
    leaderboard takes its records), and `with_settings(overrides, name)`, which returns the method with other settings
    for `run-benchmark --set`.
    """

    name: str
    params: dict[str, Any]

    def fit(self, scene: TrainingScene, request: FitRequest) -> Model:
        """Fit the training views and return the model."""
        ...


def training_for(method: Method, scene: TrainingScene) -> TrainingScene:
    """Return what a method gets of a scene: no recordings of a kind that it does not say it is given.

    Poses remain: the estimated ones are brought to the rig's frame, in which held-out cameras are given. No method gets
    points from here; one that reads them from the folder says so.
    """
    given = getattr(method, "given", DEFAULT_GIVEN)
    withheld: dict[str, Any] = {} if "flat-field" in given else {"recordings": (None,) * len(scene.cameras)}
    withheld |= {f"found_{kind}": {} for kind in ("frames", "events") if kind not in given}
    return replace(scene, **withheld)


def check_protocol(method: Any, source: str) -> None:
    """Raise UserError where a method's `fit` does not take (scene, request); `source` is where the method comes from.

    A signature that is not known, or that takes any arguments, passes.
    """
    name = getattr(method, "name", type(method).__name__)
    expected, fix = "fit(self, scene, request)", "take a FitRequest, with budget, device, seed, progress and checkpoint"
    if not callable(getattr(method, "fit", None)):
        raise problem(f"method {name!r} of {source}", expected, "no fit", fix)
    try:
        signature = inspect.signature(method.fit, follow_wrapped=False)
    except (TypeError, ValueError):  # compiled
        return
    try:
        signature.bind("scene", "request")
    except TypeError:
        earlier = "budget" in signature.parameters
        found = f"{'the earlier protocol, ' if earlier else ''}fit{signature}"
        raise problem(f"method {name!r} of {source}", expected, found, fix) from None


def find_methods() -> dict[str, Method]:
    """Return all methods of all installed packages, by name. Each entry point names a mapping from name to method.

    Raises UserError where two packages use one name, and where one cannot be imported or has another protocol.
    """
    return Table("methods", {name: found.value for name, found in find_packaged_methods().items()})


def find_packaged_methods() -> dict[str, Plugin]:
    """Return the methods as `find_methods` does, each with the package that it comes from."""
    return find_plugins(GROUP, "method", lambda name, method, source: check_protocol(method, source))


def get_method(name: str, methods: Mapping[str, Method] | None = None, where: str = "--methods") -> Method:
    """Return the method called `name`; NAME[PART.SETTING=VALUE,...] is one with other settings.

    `methods` are those to look among; all that are installed if left out. Raises UserError that says `where` the name
    is given and what are near it, and for settings that the method does not have.
    """
    known = find_methods() if methods is None else methods
    plain, bracket, inside = name.partition("[")
    if plain not in known:
        raise unknown(where, plain, sorted(known), "`spike4dgs methods`")
    return with_settings(known[plain], inside.removesuffix("]").split(",")) if bracket else known[plain]


def with_settings(method: Method, settings: Sequence[str]) -> Method:
    """Return a method with other settings, each PART.NAME=VALUE; its name states them: NAME[PART.NAME=VALUE,...].

    Raises UserError where the method has no `with_settings` or no such setting, for a value of another type, and where
    the name would be none: for settings of more than 100 characters, and beside settings that the name states.
    """
    overrides: dict[str, Any] = {}
    for text in settings:
        name, equals, value = text.partition("=")
        if not equals or not re.fullmatch(r"[A-Za-z0-9+._-]+", value):
            raise problem("--set", "PART.NAME=VALUE, such as trainer.lr_means=0.0002", repr(text), "correct it")
        try:
            overrides[name] = parse_json(value)
        except ValueError:
            overrides[name] = value  # a word
    if not overrides:
        return method
    change = getattr(method, "with_settings", None)
    if change is None:
        fix = "choose a method that `spike4dgs methods NAME` shows settings of"
        raise problem("--set", "a method that is made of settings", f"{method.name}, which has none", fix)
    stated = ",".join(settings)
    if is_changed(method.name) or len(stated) > MAX_SETTINGS:
        found = f"{method.name} with {stated[:200]}, {len(stated)} characters"
        fix = "write numbers shorter, and all in METHOD[...] or all in --set"
        raise problem("--set", f"settings of {MAX_SETTINGS} characters at most, in one list", found, fix)
    changed: Method = change(overrides, f"{method.name}[{stated}]")
    return changed


def is_changed(name: str) -> bool:
    """Return whether a method's name states settings that a user changed."""
    return "[" in name


def choose_device_for(methods: Iterable[Method], device: str) -> str:
    """Return the device that methods are fitted on, as `choose_device` does."""
    return choose_device(device, rasterizes=any(getattr(m, "rasterizes", True) for m in methods))
