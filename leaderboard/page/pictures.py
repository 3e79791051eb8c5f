"""The images of finished runs as files for the page: truth, predictions, error maps, and where things move."""

from __future__ import annotations

import io
from collections.abc import Callable
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

FOLDER = "pictures"


def write_pictures(
    out: Path, board: Board, number: int, data: Path, written: set[Path], say: Callable[[str], None]
) -> list[Any]:
    """Write the images of a board's rows that have predictions; return for each scene what is there, or None.

    Truth comes from the scene folders in `data`. What cannot be shown is told to `say`, with the reason. The paths are
    added to `written`.
    """
    found: list[Any] = []
    for s, name in enumerate(board.scenes):
        folders = {i: row.predictions[name] for i, row in enumerate(board.rows) if name in row.predictions}
        found.append(None)
        if not folders:
            continue
        try:
            scene = open_scene(data / name, allow_gaps=True, split=board.dataset["split"])
            if (revision := board.dataset["scenes"][name]) != scene.revision:
                say(f"no images of {name}: {data / name} has another revision than {revision[:12]}")
                continue
            if has_truth(scene):
                found[-1] = _write_scene(out, f"{FOLDER}/{number}/{s}", scene, board, folders, written, say)
        except UserError as e:
            say(f"no images of {name}: {e}")
    return found


def _write_scene(
    out: Path,
    below: str,
    scene: Scene,
    board: Board,
    folders: dict[int, Path],
    written: set[Path],
    say: Callable[[str], None],
) -> dict[str, Any]:
    truths = [scene.ground_truth(t) for t in scene.targets]
    boxes = crops([scene.moving(t) for t in scene.targets])
    scales = dict[int, float]()

    def write(name: str, image: UInt8) -> None:
        path = out / below / name
        write_bytes(path, webp(image))
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


def webp(image: UInt8) -> bytes:
    """Return an 8-bit image, gray [H, W] or RGB [H, W, 3], as lossless WebP."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(image).convert("RGB").save(out, "WEBP", lossless=True)
    return out.getvalue()
