"""Submitters that are killed: `python submitters.py FOLDER RECORD SUBMITTERS KILLS` reports what is left.

Each submitter is a process that submits one claimed record, and is started again whenever it was killed. Kills are
SIGKILLs at random times after a submitter began to submit.
"""

import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import time
from pathlib import Path

from spike4dgs.cli.submit import submit
from spike4dgs.leaderboard.rank import write_boards


def make_results(record: Path, folder: Path, count: int) -> list[Path]:
    """Copy a record under as many names."""
    value, paths = json.loads(record.read_text()), []
    folder.mkdir(parents=True)
    for i in range(count):
        value["method"]["name"] = f"method-{i:03d}"
        paths.append(folder / f"method-{i:03d}.json")
        paths[-1].write_text(json.dumps(value))
    return paths


def _submit(result: Path, leaderboard: Path, started: str) -> None:
    sys.stdout = sys.stderr = open(os.devnull, "w")
    Path(started).touch()
    submit(result, leaderboard=leaderboard)


def submit_under_fire(leaderboard: Path, results: list[Path], kills: int, seed: int = 0) -> tuple[int, list[int]]:
    """Submit all records at once with that many kills; return the kills that hit, and the exit codes of the others."""
    rng, hits, codes = random.Random(seed), 0, []
    fork, marks = multiprocessing.get_context("fork"), leaderboard.with_name("marks")
    marks.mkdir()

    def start(result: Path) -> multiprocessing.process.BaseProcess:
        mark = marks / result.stem
        mark.unlink(missing_ok=True)
        process = fork.Process(target=_submit, args=(result, leaderboard, str(mark)))
        process.start()
        return process

    running = {result: start(result) for result in results}
    while running:
        if hits < kills:
            victim = rng.choice(sorted(running))
            while not (marks / victim.stem).exists() and running[victim].is_alive():
                time.sleep(0.001)
            time.sleep(rng.random() * 0.1)
            if running[victim].is_alive():
                os.kill(int(running[victim].pid or 0), signal.SIGKILL)
                running[victim].join()
                hits += running[victim].exitcode == -signal.SIGKILL
        for result, process in list(running.items()):
            process.join(0 if hits < kills else None)
            if process.exitcode == -signal.SIGKILL or process.exitcode == 0 and hits < kills:
                running[result] = start(result)  # killed, or submits again, so that there is somebody to kill
            elif process.exitcode is not None:
                codes.append(process.exitcode)
                del running[result]
    return hits, codes


def lost(leaderboard: Path, results: list[Path]) -> list[str]:
    """Return the names of records that have no entry."""
    entered = {path.stem for folder in ("entries", "local") for path in (leaderboard / folder).glob("*/*.json")}
    return sorted({result.stem for result in results} - entered)


def same_boards(leaderboard: Path, copy: Path) -> bool:
    """Return whether boards made anew from the entries have the bytes of those that the submitters left."""
    for name in ("entries", "local"):
        if (leaderboard / name).is_dir():
            shutil.copytree(leaderboard / name, copy / name)
    shutil.copy(leaderboard / "LEDGER", copy)
    write_boards(copy)

    def boards(folder: Path) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in folder.glob("*.json")}

    return boards(leaderboard) == boards(copy) != {}


if __name__ == "__main__":
    root, source, count, kills = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
    everyone = make_results(source, root / "results", count)
    began = time.monotonic()
    found, exit_codes = submit_under_fire(root / "board", everyone, kills)
    (root / "copy").mkdir()
    print(
        f"{count} submitters, {found} kills, {time.monotonic() - began:.0f} s: exit codes {exit_codes}, "
        f"lost {lost(root / 'board', everyone)}, same boards {same_boards(root / 'board', root / 'copy')}"
    )
