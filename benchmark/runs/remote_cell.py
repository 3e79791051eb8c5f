"""A cell in another process or on another machine: the order that goes there, and the files that come back.

The worker reads the scene at the caller's path, and the caller writes what comes back, each folder whole. The
checkpoint lies in the caller's folder where the worker sees that folder, so that another worker goes on with the fit of
a lost one. Elsewhere it lies on the worker, and the fit of a lost worker begins again.
"""

from __future__ import annotations

import os
import socket
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import locked, write_bytes
from spike4dgs.benchmark.method import Budget, choose_device_for, no_progress
from spike4dgs.benchmark.runs.apart.fit import Apart, fit_job
from spike4dgs.benchmark.runs.apart.messages import packed_method, unpacked_method
from spike4dgs.benchmark.runs.cell import Failure, Job, failure_of
from spike4dgs.benchmark.runs.predictions import PredictionWriter
from spike4dgs.benchmark.scene.scene import Scene, open_scene


@dataclass(frozen=True)
class SharedFolder:
    """The caller's folder of a run. A worker knows that it sees the same one by the token in its file."""

    root: Path  # absolute
    token: str

    @property
    def token_file(self) -> Path:
        """The file that holds the token."""
        return self.root / ".token"

    def is_here(self) -> bool:
        """Return whether this machine sees the folder."""
        try:
            return self.token_file.read_text() == self.token
        except OSError:
            return False


@dataclass(frozen=True)
class Order:
    """A job as it travels: the scene by its path, the method pickled or by its name."""

    method: bytes | str  # str: the installed method of that name
    scene: Path  # absolute
    split: str
    revision: str
    seed: int
    device: str
    budget: Budget
    key: str  # of the caller's job
    folder: SharedFolder
    work: Path  # of the checkpoint, in the shared folder
    apart: Apart | None = None
    refined: bool | None = None


@dataclass(frozen=True)
class Fitted:
    """The files of a cell that was fitted."""

    predictions: tuple[dict[str, bytes], ...]  # of each variant: path in the folder -> content
    model: bytes | None
    notes: tuple[str, ...]


def make_order(job: Job, folder: SharedFolder, work: Path, apart: Apart | None = None) -> Order:
    """Return the order for a job. Raises an exception where the method can neither be pickled nor found by its name."""
    return Order(
        method=packed_method(job.method),
        scene=job.scene.root.absolute(),
        split=job.scene.split,
        revision=job.scene.revision,
        seed=job.seed,
        device=job.device,
        budget=job.budget,
        key=job.key,
        folder=folder,
        work=work.absolute(),
        apart=apart,
        refined=job.refined,
    )


def fit_order(order: Order) -> Fitted | Failure:
    """Fit on this machine, and return the files or the failure of the method.

    Raises UserError, which names the machine, where the scene or the installed code is not the caller's.
    """
    job = _job(order)
    with tempfile.TemporaryDirectory(prefix="spike4dgs-") as scratch:
        folders = [Path(scratch) / f"predictions-{n}" for n in range(len(job.variants))]
        model, notes = Path(scratch) / "model.safetensors", list[str]()
        with _work_folder(order, Path(scratch) / "work") as work:
            try:
                fit_job(job, folders, model, work, no_progress, notes.append, order.apart)
            except Exception as e:  # the method's failure, not the worker's
                return failure_of(e)
        files = tuple(_read_files(folder) for folder in folders)
        return Fitted(files, model.read_bytes() if model.is_file() else None, tuple(notes))


def store(fitted: Fitted, folders: Sequence[Path], model: Path) -> None:
    """Write the files of a cell: each predictions folder appears whole, after the model."""
    if fitted.model is not None:
        write_bytes(model, fitted.model)
    for folder, files in zip(folders, fitted.predictions, strict=True):
        with PredictionWriter(folder) as writer:
            writer.copy(files)


def _job(order: Order) -> Job:
    """Return the job on this machine. Raises UserError where it is another one than the caller's."""
    worker = f"worker {os.getpid()} on {socket.gethostname()}"
    scene = _open(order.scene, order.split, order.revision, worker)
    try:
        method = unpacked_method(order.method)
        device = choose_device_for([method], order.device)
        job = Job(method, scene, order.seed, device, order.budget, order.refined)
        if job.key == order.key:
            return job
        found = "another version of it or of spike4dgs"
    except (ImportError, AttributeError) as e:  # what pickle says of missing packages and classes
        found = f"{type(e).__name__}: {e}"
    except UserError as e:
        raise UserError(f"{worker}: {e}") from None
    raise problem(worker, "the caller's packages, and the method as it has it", found, "install the same there")


@lru_cache(maxsize=1)
def _open(root: Path, split: str, revision: str, worker: str) -> Scene:
    """Open a scene and check every file that a fit reads."""
    try:
        scene = open_scene(root, allow_gaps=True, split=split)  # the caller decides about gaps
        if scene.revision == revision:
            _ = scene.training
            return scene
        found = f"revision {scene.revision[:16]}"
    except UserError as e:
        found = str(e)
    fix = "copy or mount the scenes at the same path on every worker"
    raise problem(f"{root} on {worker}", f"the caller's scene, revision {revision[:16]}", found, fix)


@contextmanager
def _work_folder(order: Order, spare: Path) -> Iterator[Path]:
    """Yield the caller's folder for the checkpoint, or `spare` where it is not here or another process fits in it."""
    lock = order.work.with_suffix(".lock")
    with ExitStack() as held:
        work = spare
        if order.folder.is_here():
            with suppress(UserError, OSError):
                held.enter_context(locked(lock, order.work, "a fit that no other worker does", temporary=True))
                work = order.work
        yield work


def _read_files(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
