"""A dask cluster of processes of this machine, as its command line starts it; run as a script, a caller of it."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dummy_methods import CountMethod, WaitingMethod, run, wait_for


@contextmanager
def dask_cluster(
    folder: Path, workers: int, nanny: bool = True, **settings: str
) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Yield the address of a scheduler that has its workers, and its process. `settings` are of DASK_DISTRIBUTED.

    Without nannies a worker that dies is not started again.
    """
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{s.getsockname()[1]}"
    path = os.pathsep.join(filter(None, (str(Path(__file__).parent), os.environ.get("PYTHONPATH"))))
    settings |= {"WORKER__PROFILE__ENABLED": "False"}  # it looks at every thread a hundred times a second
    env = {**os.environ, "PYTHONPATH": path, **{f"DASK_DISTRIBUTED__{k}": v for k, v in settings.items()}}
    scheduler = ["scheduler", "--host", address, "--no-dashboard", "--no-jupyter"]
    worker = ["worker", address, "--nthreads", "1", "--no-dashboard", "--memory-limit", "0"]
    worker += ["--local-directory", str(folder)]
    all_workers = [[*worker, "--nworkers", str(workers)]] if nanny else [[*worker, "--no-nanny"]] * workers
    names = ("scheduler", *(f"worker-{k}" for k in range(len(all_workers))))
    logs = [open(folder / f"{name}.log", "wb") for name in names]
    started = [
        subprocess.Popen([sys.executable, "-m", "dask", *arguments], env=env, stdout=log, stderr=log)
        for arguments, log in zip((scheduler, *all_workers), logs, strict=True)
    ]
    try:
        wait_for(lambda: (folder / "scheduler.log").read_text().count("Register worker") >= workers)
        yield address, started[0]
    finally:
        for process in reversed(started):
            process.terminate()
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for log in logs:
            log.close()


if __name__ == "__main__":  # a caller: OUT SCENE SCHEDULER FOLDER
    out, scene, scheduler, folder = sys.argv[1:]
    methods = (CountMethod("quick"), WaitingMethod("waiting", Path(folder)))
    run(Path(out), [Path(scene)], *methods, metrics=("psnr",), scheduler=scheduler)
