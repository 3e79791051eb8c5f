"""The predictions folder, which a method hands to the judge.

    cam_04/000120.exr   gray linear radiance (half float, channel Y), named by camera and tick as in targets.json
    SHA256SUMS          the images' hashes in the format of coreutils: `sha256sum -c SHA256SUMS` checks the folder
    prediction.json     who made them, on what, and what it cost

Any program can write one: the images, `sha256sum */*.exr > SHA256SUMS`, and a prediction.json with at least
`{"schema": "spike4dgs-prediction/1", "method": {"name": "..."}, "scene": "..."}`.
"""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.environment import utc_now
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import MOST_BYTES, read_json, sha256_file, write_bytes, write_json, write_text, writing
from spike4dgs.benchmark.runs.held_out import targets_of
from spike4dgs.benchmark.scene.images import read_exr, write_exr
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.benchmark.schemas import check_schema, load_schema

SCHEMA = "spike4dgs-prediction/1"
SUMS, INFO = "SHA256SUMS", "prediction.json"
MOST_OF_IMAGE = 1 << 30  # bytes; noise of 8 Mpx has 16 MiB
_LINE = re.compile(r"([0-9a-fA-F]{64}) [ *](.+)")


@dataclass(frozen=True)
class MethodInfo:
    """The identity of a method.

    `trained_on` lists the data sets that learned parts were trained on (contamination), `given` what of `method.GIVEN`
    it was given; None stands for all, and for older records. `oracle` lists what an oracle replaced by the truth or
    freed of a limit: no leaderboard takes such a record.
    """

    name: str
    version: str | None = None
    params: dict[str, Any] = field(default_factory=dict)
    seed: int | None = None
    trained_on: tuple[str, ...] = ()
    given: tuple[str, ...] | None = None
    oracle: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; without `given` where it is None, and without `oracle` where it is empty."""
        added = {} if self.given is None else {"given": list(self.given)}
        if self.oracle:
            added["oracle"] = list(self.oracle)
        rest = {k: v for k, v in asdict(self).items() if k not in ("given", "oracle")}
        return {**rest, "trained_on": list(self.trained_on), **added}


@dataclass(frozen=True)
class PredictionInfo:
    """prediction.json. Everything that another program may not know is None."""

    method: MethodInfo
    scene: str
    scene_revision: str | None = None
    split: str | None = None  # None: the scene's default one
    budget: float | str | None = None  # multiple of the quick budget, or "paper"
    device: str | None = None
    fit_seconds: float | None = None
    render_fps: float | None = None
    peak_memory_mb: float | None = None
    model_mb: float | None = None  # what the fitted model takes on disk, without code
    environment: dict[str, Any] | None = None
    harness: dict[str, Any] | None = None  # version, commit and dirty flag of the code that fitted
    key: str | None = None  # the runner's content key
    created: str | None = None


@dataclass(frozen=True)
class Predictions:
    """An opened predictions folder: complete for its targets, hashes not yet checked (`read` and `verify` do)."""

    root: Path
    info: PredictionInfo
    sums: dict[str, str]  # relative path -> sha256
    sha256: str  # of the text of SHA256SUMS

    def read(self, target: Target, shape: tuple[int, int] | None = None) -> NDArray[np.float32]:
        """Read the predicted radiance of a target [H, W].

        Raises UserError where the file differs from SHA256SUMS, and where the image is not of that `shape` (if given).
        """
        self._check(f"{target.name}.exr")
        return read_exr(self.root / f"{target.name}.exr", shape)

    def verify(self) -> None:
        """Hash every image. Raises UserError at the first that differs from SHA256SUMS."""
        for name in self.sums:
            self._check(name)

    def _check(self, name: str) -> None:
        if (size := (self.root / name).stat().st_size) > MOST_OF_IMAGE:  # before it is read
            expected = f"an image of a target, {MOST_OF_IMAGE} bytes at most"
            raise problem(self.root / name, expected, f"{size}", "render it again")
        if (found := sha256_file(self.root / name)) != self.sums[name]:
            fix = f"restore the image, or run the method again; {SUMS} must be written after the images"
            raise problem(self.root / name, f"sha256 {self.sums[name][:16]}...", f"{found[:16]}...", fix)


def open_predictions(root: Path, targets: Sequence[Target]) -> Predictions:
    """Open a predictions folder for the targets of its scene.

    Raises UserError where the folder, SHA256SUMS or prediction.json is missing or damaged, and where predictions are
    missing or more than the targets (with the first five names).
    """
    if not root.is_dir():
        raise problem(root, "a predictions folder", "no such folder", "check the path or run the method")
    info = read_info(root)
    text, sums = _read_sums(root / SUMS)
    expected = {f"{t.name}.exr" for t in targets}
    listed = f"those of the scene's targets in {SUMS}"
    _same_names(root, set(sums), expected, listed, "list exactly the targets in targets.json")
    present = {p.relative_to(root).as_posix() for p in root.rglob("*.exr") if p.is_file()}
    _same_names(root, present, expected, "one image for each target", "render exactly the targets in targets.json")
    return Predictions(root, info, sums, hashlib.sha256(text).hexdigest())


def read_info(root: Path) -> PredictionInfo:
    """Read and validate prediction.json. Raises UserError where it is missing or invalid."""
    data = read_json(root / INFO, f"a {SCHEMA} description")
    schema = load_schema("spike4dgs.benchmark", "prediction.schema.json")
    check_schema(data, schema, root / INFO, "correct it (see the predictions module for the smallest valid one)")
    values = {k: v for k, v in data.items() if k not in ("schema", "method")}
    lists = {key: tuple(data["method"][key]) for key in ("trained_on", "given", "oracle") if key in data["method"]}
    method = {**data["method"], **lists}
    return PredictionInfo(method=MethodInfo(**method), **values)


def _read_sums(path: Path) -> tuple[bytes, dict[str, str]]:
    fix = "write it with `sha256sum */*.exr > SHA256SUMS`"
    if not path.is_file():
        raise problem(path, "the hashes of the images", "no such file", fix)
    if (size := path.stat().st_size) > MOST_BYTES:
        raise problem(path, f"the hashes of the images, {MOST_BYTES} bytes at most", f"{size}", fix)
    data = path.read_bytes()
    sums: dict[str, str] = {}
    for number, line in enumerate(data.decode("utf-8", errors="replace").splitlines(), start=1):
        found = _LINE.fullmatch(line)
        if not found or found[2] in sums:
            raise problem(path, "lines of a sha256, two blanks and a new name", f"line {number}: {line[:80]!r}", fix)
        sums[found[2]] = found[1].lower()
    return data, sums


def _same_names(root: Path, found: set[str], expected: set[str], what: str, fix: str) -> None:
    for kind, names in (("missing", sorted(expected - found)), ("extra", sorted(found - expected))):
        if names:
            more = f" and {len(names) - 5} more" if len(names) > 5 else ""
            raise problem(root, what, f"{len(names)} {kind}: {', '.join(names[:5])}{more}", fix)


class PredictionWriter:
    """Write a predictions folder that appears under its name only when it is whole.

    Inside `with`, call `add` for every target and `finish` once; the folder is renamed into place on exit.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._part = root.with_name(f".{root.name}.part")
        self._names: list[str] = []
        self._finished = False

    def __enter__(self) -> PredictionWriter:
        shutil.rmtree(self._part, ignore_errors=True)  # what a killed run left
        with writing(self.root):
            self._part.mkdir(parents=True)
        return self

    def add(self, target: Target, image: NDArray[np.float32], t_us: float) -> None:
        """Store one image [H, W], linear radiance. Raises UserError for values that half floats cannot hold."""
        write_exr(self._part / f"{target.name}.exr", image, t_us)
        self._names.append(f"{target.name}.exr")

    def add_file(self, target: Target, data: bytes) -> None:
        """Store the file of an image that another process wrote."""
        write_bytes(self._part / f"{target.name}.exr", data)
        self._names.append(f"{target.name}.exr")

    def finish(self, info: PredictionInfo) -> None:
        """Write SHA256SUMS and prediction.json."""
        lines = [f"{sha256_file(self._part / name)}  {name}\n" for name in sorted(self._names)]
        write_text(self._part / SUMS, "".join(lines))
        write_json(self._part / INFO, {"schema": SCHEMA, **asdict(info), "method": info.method.as_dict()})
        self._finished = True

    def copy(self, files: Mapping[str, bytes]) -> None:
        """Write the files of a whole predictions folder, by their paths in it, in place of `add` and `finish`."""
        for name, data in files.items():
            write_bytes(self._part / name, data)
        self._finished = True

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._finished and kind is None:
            shutil.rmtree(self.root, ignore_errors=True)
            self._part.rename(self.root)
        else:
            shutil.rmtree(self._part, ignore_errors=True)


def check_place(root: Path) -> None:
    """Raise UserError where something else than earlier predictions is, which a PredictionWriter would replace."""
    if root.exists() and not (root / INFO).is_file():
        raise problem(root, "a new folder, or earlier predictions", "something else", "choose another folder")


def write_predictions(
    root: Path | str,
    scene: Scene | Path | str,
    images: Mapping[Target, NDArray[np.floating[Any]]],
    method: str,
    *,
    fit_seconds: float | None = None,
    render_fps: float | None = None,
) -> Path:
    """Write the images that any program made of a scene's targets as a predictions folder, and return its path.

    `images`: gray linear radiance [H, W], 1.0 = white, for each of `scene.targets`; of a recording, which has none, for
    each tick at which `score` compares spikes. `method`: the program's name. An earlier folder at `root` is replaced if
    it holds predictions. Raises UserError for missing or further targets, for other shapes or values that are not
    finite, where something else is at `root`, and for a recording that holds no camera out.

    For example::

        images = {t: render(scene.cameras[t.camera], scene.t_us(t.tick)) for t in scene.targets}
        write_predictions("runs/mine", scene, images, "my-method")
    """
    root, opened = Path(root).absolute(), scene if isinstance(scene, Scene) else open_scene(scene)
    check_place(root)
    fix = "give an image for each target, and no others"
    _same_names(root, {t.name for t in images}, {t.name for t in targets_of(opened)}, "the scene's targets", fix)
    with PredictionWriter(root) as writer:
        for target, image in images.items():
            camera = opened.cameras[target.camera]
            if image.shape != (camera.height, camera.width) or not np.isfinite(image).all():
                expected = f"finite radiance [{camera.height}, {camera.width}]"
                found = f"{image.shape}" if np.isfinite(image).all() else "NaN or infinity"
                raise problem(f"image of {target.name}", expected, found, "correct the image")
            writer.add(target, np.asarray(image, np.float32), opened.t_us(target.tick))
        writer.finish(
            PredictionInfo(
                MethodInfo(method),
                scene=opened.id,
                scene_revision=opened.revision,
                split=opened.split,
                created=utc_now(),
                fit_seconds=fit_seconds,
                render_fps=render_fps,
            )
        )
    return root
