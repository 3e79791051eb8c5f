"""Fit in a process that sees a training part alone, and take from it what it made.

The process gets a scene without truth, without anything of the held-out cameras but their poses, and without a word on
how the scene was made. The caller writes the predictions: it takes the images, and states itself what they are of. The
same fit has the same bits here and in the caller's process.

A process may still read what its user may read: only a container keeps a method from files that it looks for. `Apart`
takes the command that starts one.
"""

from __future__ import annotations

import io
import json
import os
import select
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast
from uuid import uuid4

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.method import DEFAULT_GIVEN, Progress
from spike4dgs.benchmark.release.publish import TOKENS
from spike4dgs.benchmark.release.source import VARIABLE as RELEASE
from spike4dgs.benchmark.runs.apart.messages import (
    DONE,
    FAILED,
    MODEL,
    MOST,
    NOTE,
    PROGRESS,
    RENDERED,
    Order,
    Rest,
    identity,
    images_folder,
    packed_method,
    parse_line,
    read_costs,
    read_image,
    send,
)
from spike4dgs.benchmark.runs.apart.training_part import write_nameless_part
from spike4dgs.benchmark.runs.cell import Failure, FitFailed, Job, prediction_info, provenance_of, run_job
from spike4dgs.benchmark.runs.predictions import PredictionWriter
from spike4dgs.benchmark.runs.refinement import views_of

# Without the working folder on the path (-P), but with the caller's path. SIGINT ends it silently while it starts.
_CODE = (
    "import json, signal, sys; signal.signal(signal.SIGINT, signal.SIG_DFL); given = json.loads(sys.argv.pop()); "
    "sys.path[:] = given + [p for p in sys.path if p not in given]; "
    "from spike4dgs.benchmark.runs.apart.child import main; sys.exit(main())"
)
_HIDDEN = (RELEASE, "OLDPWD", *TOKENS.values())  # variables that tell where scenes lie, and tokens to publish with
_FOLDERS = ("SPIKE4DGS_", "TORCH_HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR")  # beginnings of variables of folders
_WORDS = ("SPIKE4DGS_MITSUBA_VARIANT",)  # that begin so and name none
_END_S = 5.0  # for a process to end by itself
_POLL_S = 0.5  # without a line, until one looks whether it still runs
WORK, PART = "{work}", "{part}"  # in a container's command


@dataclass(frozen=True)
class Apart:
    """Fits have a process each. `container` is the command that starts it, if any; WORK and PART are its folders."""

    container: str = ""

    def command(self, work: Path, part: Path) -> list[str]:
        """Return the words of the container's command. Raises UserError for one that no shell reads."""
        try:
            words = shlex.split(self.container)
        except ValueError as e:
            raise problem("--container", "a command", f"{self.container!r} ({e})", "correct its quotes") from None
        return [word.replace(WORK, str(work)).replace(PART, str(part)) for word in words]


def fit_job(
    job: Job,
    folders: Sequence[Path],
    model_path: Path,
    work: Path,
    progress: Progress,
    note: Callable[[str], None],
    apart: Apart | None,
) -> None:
    """Do what `cell.run_job` does: here, or with `apart` in a process that sees the training part alone."""
    if apart is None:
        run_job(job, folders, model_path, work, progress, note)
    else:
        fit_apart(job, folders, model_path, work, progress, note, apart)


def fit_apart(
    job: Job,
    folders: Sequence[Path],
    model_path: Path,
    work: Path,
    progress: Progress,
    note: Callable[[str], None],
    apart: Apart = Apart(),
) -> None:
    """Do what `cell.run_job` does, in a process that sees the training part alone.

    Raises FitFailed where the method fails there, UserError where the process dies or says what it must not.
    """
    work = work.absolute()
    work.mkdir(parents=True, exist_ok=True)
    packed, where = packed_method(job.method), f"the process of {job.method.name}"
    for variant in range(len(folders)):
        shutil.rmtree(images_folder(work, variant), ignore_errors=True)
    with _training_part(job, work) as part, _started(part, work, apart) as process:
        child = _Child(process, where, progress, note)
        order = Order(
            method=packed,
            code=identity(job.method),
            part=part,
            work=work,
            revision=job.scene.revision,
            cameras=dict(job.scene.cameras),
            seed=job.seed,
            device=job.device,
            budget=job.budget,
        )
        child.send(order)
        _take(job, folders, model_path, work, child)
    shutil.rmtree(work)


def _take(job: Job, folders: Sequence[Path], model_path: Path, work: Path, child: _Child) -> None:
    """Take the images of each variant as it is rendered, then the model; the predictions appear after it."""
    with ExitStack() as unfinished:
        for number, (method, folder) in enumerate(zip(job.variants, folders, strict=True)):
            costs = read_costs(child.wait(RENDERED), child.where)
            writer = unfinished.enter_context(PredictionWriter(folder))
            for target in job.scene.targets:
                writer.add_file(target, read_image(images_folder(work, number), f"{target.name}.exr"))
            writer.finish(prediction_info(job, method, costs))
            if not number:
                views = views_of(job.scene) if len(folders) > 1 else ()
                child.send(Rest(provenance_of(job, cast(float, costs["fit_seconds"])), views))
        child.wait(DONE)
        if (work / MODEL).is_file() and not (work / MODEL).is_symlink():
            with atomic_path(model_path) as part:  # a worker's own folder may lie on another disk
                shutil.move(work / MODEL, part)


class _Child:
    """The process that fits, as its caller sees it."""

    def __init__(
        self, process: subprocess.Popen[bytes], where: str, progress: Progress, note: Callable[[str], None]
    ) -> None:
        self._process, self.where, self._progress, self._note = process, where, progress, note

    def send(self, value: Any) -> None:
        """Send an object. Raises UserError where the process has ended."""
        try:
            send(cast(IO[bytes], self._process.stdin), value)
        except BrokenPipeError:
            raise self._ended() from None

    def wait(self, wanted: str) -> Any:
        """Return the value of the next line of a kind; pass on what the process reports until then.

        Raises FitFailed with the failure that it reports, UserError where it ends or says anything else.
        """
        while line := self._line():
            kind, value = parse_line(line, self.where)
            try:
                if kind == PROGRESS:
                    done, total, note = value
                    self._progress(int(done), int(total), str(note))
                elif kind == NOTE:
                    self._note(str(value))
                elif kind == FAILED:
                    status = "skipped" if value["status"] == "skipped" else "failed"
                    raise FitFailed(Failure(status, str(value["reason"]), str(value["traceback"])))
                elif kind == wanted:
                    return value
                else:
                    raise ValueError(kind)
            except (TypeError, ValueError, KeyError) as e:
                raise problem(self.where, f"the line {wanted}", f"{type(e).__name__}: {e}", "correct the method") from e
        raise self._ended()

    def _line(self) -> bytes:
        """Return the next line; none at the end, and where the process has died while a child of its own goes on."""
        # Without the buffer, of which `poll` knows nothing.
        pipe = cast(io.RawIOBase, cast(io.BufferedReader, self._process.stdout).raw)
        if hasattr(select, "poll"):  # Windows has none
            waiting = select.poll()
            waiting.register(pipe, select.POLLIN)
            while not waiting.poll(1000 * _POLL_S):
                if self._process.poll() is not None and not waiting.poll(0):  # not even a last line
                    return b""
        return pipe.readline(MOST)

    def _ended(self) -> Exception:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
        code = self._process.returncode
        found = f"its end by signal {-code} (out of memory?)" if code and code < 0 else f"exit code {code}"
        return problem(self.where, "that it ends its fit", found, "see above what it printed")


@contextmanager
def _training_part(job: Job, work: Path) -> Iterator[Path]:
    """Write the training part and remove it at the end.

    Each has a folder of its own among the work, where nothing of the scene is near: the process of a fit whose caller
    was killed may still be removing another.
    """
    for left in work.glob("*part-*"):
        shutil.rmtree(left, ignore_errors=True)
    folder = work / f"part-{uuid4().hex[:16]}"
    given = getattr(job.method, "given", DEFAULT_GIVEN)
    try:
        yield write_nameless_part(job.scene, folder, given).root
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _started(part: Path, work: Path, apart: Apart) -> Iterator[subprocess.Popen[bytes]]:
    """Start the process in its part, and end it whatever happens."""
    paths = json.dumps([str(Path(p).absolute()) for p in sys.path])
    command = [*apart.command(work, part), sys.executable, "-P", "-c", _CODE, paths]
    try:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=part, env=_environment(part)
        )
    except OSError as e:
        raise problem("--container", "a program that starts", f"{command[0]}: {e.strerror}", "install it") from None
    try:
        yield process
    except KeyboardInterrupt:  # the terminal interrupts both: the method may clean up
        with suppress(subprocess.TimeoutExpired):
            process.wait(_END_S)
        raise
    finally:
        process.kill()
        process.wait()
        with suppress(BrokenPipeError):
            cast(IO[bytes], process.stdin).close()
        cast(IO[bytes], process.stdout).close()


def _environment(part: Path) -> dict[str, str]:
    """Return the variables of the process: those of this one, paths absolute, without what no fit may know."""
    kept = {name: value for name, value in os.environ.items() if name not in _HIDDEN}
    named = {name: value for name, value in kept.items() if value and name.startswith(_FOLDERS) and name not in _WORDS}
    folders = {name: str(Path(value).expanduser().absolute()) for name, value in named.items()}
    return {**kept, **folders, "PWD": str(part)}
