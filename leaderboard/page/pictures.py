"""The page's images: those of finished runs as files of their own, and the sheets of entries as they are.

A scene that has images of a run shows these: truth, predictions and error maps of every target. Any other shows the
thumbnails of the entries, one target each, which the page cuts from the sheets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import write_bytes
from spike4dgs.benchmark.reports.error_map import absolute_error, choose_scale, error_levels
from spike4dgs.benchmark.reports.panels import crops
from spike4dgs.benchmark.runs.held_out import has_truth
from spike4dgs.benchmark.runs.predictions import open_predictions
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.leaderboard.page.rows import Board
from spike4dgs.leaderboard.thumbnails import SUFFIX, read_sheet, sheet_size, top_of, webp
from spike4dgs.leaderboard.tracks import match_release

FOLDER = "pictures"


def write_pictures(
    out: Path, board: Board, number: int, data: Path, written: set[Path], say: Callable[[str], None]
) -> list[Any]:
    """Write the images of a board's rows that have predictions or sheets; return for each scene what is there, or None.

    Truth comes from the scene folders in `data`. What cannot be shown is told to `say`, with the reason. The paths are
    added to `written`.
    """
    sheets, found = _write_sheets(out, board, written, say), list[Any]()
    for s, name in enumerate(board.scenes):
        of_run = _of_run(out, f"{FOLDER}/{number}/{s}", name, board, data, written, say)
        found.append(of_run or _of_sheets(name, board, sheets, say))
    return found


def _of_run(
    out: Path, below: str, name: str, board: Board, data: Path, written: set[Path], say: Callable[[str], None]
) -> dict[str, Any] | None:
    folders = {i: row.predictions[name] for i, row in enumerate(board.rows) if name in row.predictions}
    if not folders:
        return None
    try:
        scene = open_scene(data / name, allow_gaps=True, split=board.dataset["split"])
        if (revision := board.dataset["scenes"][name]) != scene.revision and revision != _released(scene):
            say(f"no images of {name}: {data / name} has another revision than {revision[:12]}")
        elif has_truth(scene):
            return _write_scene(out, below, scene, board, folders, written, say)
    except UserError as e:
        say(f"no images of {name}: {e}")
    return None


def _released(scene: Scene) -> str | None:
    """Return the release's revision that a scene is equivalent to; None where there is none."""
    match = match_release(scene)
    return match.revision if match and match.is_equivalent else None


def _write_sheets(out: Path, board: Board, written: set[Path], say: Callable[[str], None]) -> dict[int, str]:
    """Copy the sheets of a board's rows, each once for all boards; return their paths on the page by row."""
    found = {}
    for i, row in enumerate(board.rows):
        if row.sheet and row.thumbnails:
            try:
                content = read_sheet(row.sheet, row.thumbnails)
            except UserError as e:
                say(f"no thumbnails of {row.name}: {e}")
                continue
            found[i] = f"{FOLDER}/sheets/{row.thumbnails['sha256']}{SUFFIX}"
            if out / found[i] not in written:
                write_bytes(out / found[i], content)
                written.add(out / found[i])
    return found


def _of_sheets(name: str, board: Board, sheets: Mapping[int, str], say: Callable[[str], None]) -> dict[str, Any] | None:
    """Return the thumbnails of a scene: those of one target and one size, as the first row that has any."""
    stated = {i: board.rows[i].thumbnails for i in sheets if name in board.rows[i].thumbnails["scenes"]}
    if not stated:
        return None
    first, *_ = (of["scenes"][name] for of in stated.values())
    same = ("target", "width", "height")
    rows, scales, places = [], dict[int, float](), dict[int, Any]()
    for i, of in stated.items():
        own = of["scenes"][name]
        if any(own[key] != first[key] for key in same):
            say(f"no thumbnails of {board.rows[i].name} on {name}: of another target or size than the first row's")
            continue
        width, height = sheet_size(of)
        rows.append(i)
        scales[i] = own["scale"]
        places[i] = {"file": sheets[i], "top": top_of(of, name), "width": width, "height": height}
    return {
        "sheets": places,
        "width": first["width"],
        "height": first["height"],
        "names": [first["target"]],
        "crops": [first["crop"]],
        "scales": scales,
        "rows": rows,
    }


def _write_scene(
    out: Path,
    below: str,
    scene: Scene,
    board: Board,
    folders: dict[int, Path],
    written: set[Path],
    say: Callable[[str], None],
) -> dict[str, Any] | None:
    truths = [scene.ground_truth(t) for t in scene.targets]
    boxes = crops([scene.moving(t) for t in scene.targets])
    scales = dict[int, float]()

    def write(name: str, image: UInt8) -> None:
        path = out / below / name
        write_bytes(path, webp(image, lossless=True))
        written.add(path)

    for k, truth in enumerate(truths):
        write(f"truth/{k}.webp", encode_srgb(truth))
    rows = []
    for i, folder in folders.items():
        try:
            predictions = open_predictions(folder, scene.targets)
            if predictions.sha256 != board.rows[i].first["scenes"][scene.id]["predictions_sha256"]:
                say(f"no images of {board.rows[i].name} on {scene.id}: {folder} has others than were scored")
                continue
            errors = []
            for k, (target, truth) in enumerate(zip(scene.targets, truths, strict=True)):
                image = predictions.read(target, truth.shape)
                write(f"{i}/{k}.webp", encode_srgb(image))
                write(f"{i}/{k}-error.webp", error_levels(image, truth))
                error, box = absolute_error(image, truth), boxes[k]
                errors.append(box.of(error) if box else error)
            scales[i] = choose_scale(errors)
            rows.append(i)
        except UserError as e:
            say(f"no images of {board.rows[i].name} on {scene.id}: {e}")
    if not rows:
        return None
    height, width = truths[0].shape
    return {
        "folder": below,
        "width": width,
        "height": height,
        "names": [t.name for t in scene.targets],
        "ms": [scene.t_us(t.tick) / 1000 for t in scene.targets],
        "crops": boxes,
        "scales": scales,  # of error maps, by row: what the page starts with
        "rows": rows,
    }
