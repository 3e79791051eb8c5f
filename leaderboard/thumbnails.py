"""The sheet of an entry: for each scene truth, render and error of one target, small, in one image beside the entry.

    LEADERBOARD/entries/RELEASE-TRACK@REVISION/METHOD.webp

A row of the sheet is a scene, in the order of their ids, and has three thumbnails of one size: the truth, the render,
and error levels (`error_map.error_levels`). The entry states the sheet's SHA-256 and what is in each row, so that the
ledger covers both. `submit` makes the sheet from the predictions that it scored again. Only the check of an entry from
its predictions decodes one.
"""

from __future__ import annotations

import hashlib
import io
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Float64, UInt8
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import read_bytes
from spike4dgs.benchmark.reports.error_map import absolute_error, choose_scale, error_levels
from spike4dgs.benchmark.reports.panels import Box, crops
from spike4dgs.benchmark.runs.held_out import has_truth
from spike4dgs.benchmark.runs.predictions import Predictions, open_predictions
from spike4dgs.benchmark.runs.record import Record
from spike4dgs.benchmark.runs.score import prediction_folders
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import Scene

KEY = "thumbnails"  # of an entry
SUFFIX = ".webp"
COLUMNS = 3  # truth, render, error
LARGEST = 200  # pixels of a thumbnail's longer side: images of the tracks keep their size
MOST_ROWS = 81  # WebP has 16383 pixels a side at most; further scenes have no thumbnails
MOST_BYTES = 4 << 20
QUALITY = 50  # of the lossy WebP: nine scenes of 200x125 pixels take 95 KB
# Another encoder gives other bytes: means of blocks are compared. Of the nine scenes they differ by 5 levels at most
# between other efforts of the encoder, and by 10 with noise of 0.003 in the truth.
BLOCK, MOST_LEVELS = 8, 20.0


@dataclass(frozen=True)
class Thumbnails:
    """The sheet of an entry, and what the entry says of it: `sha256`, and what is in the row of each scene."""

    sheet: bytes
    stated: Mapping[str, Any]


def sheet_path(entry: Path) -> Path:
    """Return the path of an entry's sheet."""
    return entry.with_suffix(SUFFIX)


def sheets(leaderboard: Path, *folders: str) -> list[Path]:
    """Return the sheets in some folders of a leaderboard, whether or not an entry states them."""
    found = [sheet for folder in folders for sheet in sorted((leaderboard / folder).glob(f"*/*{SUFFIX}"))]
    return [sheet for sheet in found if not sheet.name.startswith(".")]


def make_thumbnails(record: Record, predictions: Path, scenes: Sequence[Scene]) -> Thumbnails | None:
    """Return the thumbnails of a record's scored scenes that have truth, of the middle target each; None without any.

    Equal inputs give equal bytes. Raises UserError where the predictions are not those that were scored.
    """
    used = sorted((s for s in scenes if s.id in record["scenes"]), key=lambda scene: scene.id)
    folders = prediction_folders(predictions, used)
    rows, stated = list[UInt8](), dict[str, Any]()
    for scene in [s for s in used if record["scenes"][s.id]["status"] == "ok" and has_truth(s)][:MOST_ROWS]:
        found, expected = open_predictions(folders[scene.id], scene.targets), record["scenes"][scene.id]
        if found.sha256 != expected["predictions_sha256"]:
            raise problem(found.root, "the predictions that were scored", "others", "give them")
        row, stated[scene.id] = _row(scene, found)
        rows.append(row)
    if not rows:
        return None
    sheet = np.zeros((sum(len(row) for row in rows), max(row.shape[1] for row in rows)), np.uint8)
    y = 0
    for row in rows:
        sheet[y : (y := y + len(row)), : row.shape[1]] = row
    data = webp(sheet, quality=QUALITY, method=6)
    return Thumbnails(data, {"sha256": hashlib.sha256(data).hexdigest(), "scenes": stated})


def _row(scene: Scene, predictions: Predictions) -> tuple[UInt8, dict[str, Any]]:
    """Return a scene's row [h, 3 w], and what the entry says of it."""
    middle = len(scene.targets) // 2
    target = scene.targets[middle]
    truth = scene.ground_truth(target)
    image = predictions.read(target, (truth.shape[0], truth.shape[1]))
    box, error = crops([scene.moving(t) for t in scene.targets])[middle], absolute_error(image, truth)
    shrink = min(1.0, LARGEST / max(truth.shape))
    height, width = (max(1, round(side * shrink)) for side in truth.shape)
    parts = (encode_srgb(truth), encode_srgb(image), error_levels(image, truth))
    return np.hstack([_resized(part, width, height) for part in parts]), {
        "target": target.name,
        "width": width,
        "height": height,
        "crop": list(_shrunk(box, shrink, width, height)) if box else None,
        "scale": choose_scale([box.of(error) if box else error]),
    }


def _resized(image: UInt8, width: int, height: int) -> UInt8:
    """Return an image of that size; each pixel is the mean of those that it covers."""
    from PIL import Image

    if image.shape == (height, width):
        return image
    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BOX))


def _shrunk(box: Box, shrink: float, width: int, height: int) -> Box:
    left, top = min(round(box.x * shrink), width - 1), min(round(box.y * shrink), height - 1)
    right, bottom = (round(end * shrink) for end in (box.x + box.width, box.y + box.height))
    return Box(left, top, min(max(right - left, 1), width - left), min(max(bottom - top, 1), height - top))


def webp(image: UInt8, **options: Any) -> bytes:
    """Return an 8-bit image, gray [H, W] or RGB [H, W, 3], as WebP, with options of Pillow."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(image).convert("RGB").save(out, "WEBP", **options)
    return out.getvalue()


def read_sheet(path: Path, stated: Mapping[str, Any]) -> bytes:
    """Return the bytes of the sheet of which an entry states this. Nothing is decoded.

    Raises UserError unless the file is there with the hash and with the size that follows from the rows.
    """
    data = read_bytes(path, "the thumbnails that its entry states", MOST_BYTES)
    fix = "restore it, or submit the record again with predictions and scenes"
    if (found := hashlib.sha256(data).hexdigest()) != stated["sha256"]:
        raise problem(path, f"sha256 {stated['sha256'][:16]}... as its entry states", f"{found[:16]}...", fix)
    expected, size = sheet_size(stated), _webp_size(data)
    if size != expected:
        shown = f"{size[0]}x{size[1]}" if size else "another file"
        raise problem(path, f"a lossy WebP image of {expected[0]}x{expected[1]} pixels", shown, fix)
    return data


def has_sheet(path: Path, entry: Mapping[str, Any]) -> bool:
    """Return whether the entry at a path states thumbnails, and its sheet is there."""
    try:
        return KEY in entry and bool(read_sheet(sheet_path(path), entry[KEY]))
    except UserError:
        return False


def check_sheet(path: Path, stated: Mapping[str, Any], made: Thumbnails | None) -> None:
    """Raise UserError unless the sheet of which an entry states this shows what was `made` now, as far as is seen."""
    data = read_sheet(path, stated)
    fix = "submit the record again with --replace"
    if (shown := _shown(stated)) != (now := _shown(made.stated) if made else "nothing"):
        raise problem(path, f"thumbnails of {now}", shown, fix)
    if made is None or data == made.sheet:
        return
    difference = np.abs(_block_means(path, data) - _block_means(path, made.sheet)).max()
    if difference > MOST_LEVELS:
        raise problem(path, "the images that were scored", f"others, by {difference:.0f} of 255 levels", fix)


def _shown(stated: Mapping[str, Any]) -> str:
    """Return what is in the rows."""
    rows = sorted(stated["scenes"].items())
    return ", ".join(f"{scene} {row['target']} {row['width']}x{row['height']}" for scene, row in rows)


def _block_means(path: Path, sheet: bytes) -> Float64:
    """Return the mean levels of a sheet's blocks; those at the right and at the bottom are smaller."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(sheet), formats=("WEBP",)) as image:
            levels = np.asarray(image.convert("L"), np.float64)
    except (OSError, ValueError) as e:
        raise problem(path, "a WebP image", f"damaged data ({e})", "submit the record again with --replace") from None
    rows, columns = (np.arange(0, side, BLOCK) for side in levels.shape)
    sums = np.add.reduceat(np.add.reduceat(levels, rows, axis=0), columns, axis=1)
    counts = np.outer(*(np.diff([*starts, side]) for starts, side in zip((rows, columns), levels.shape, strict=True)))
    return np.asarray(sums / counts)


def sheet_size(stated: Mapping[str, Any]) -> tuple[int, int]:
    """Return width and height of the sheet of which an entry states this."""
    rows = stated["scenes"].values()
    return max(COLUMNS * row["width"] for row in rows), sum(row["height"] for row in rows)


def top_of(stated: Mapping[str, Any], scene: str) -> int:
    """Return where the row of a scene begins, in pixels from the top of the sheet."""
    return sum(row["height"] for name, row in stated["scenes"].items() if name < scene)


def _webp_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height of a lossy WebP image from its header (RFC 9649, RFC 6386); None for any other file."""
    if len(data) < 30 or data[:4] != b"RIFF" or data[8:16] != b"WEBPVP8 " or data[23:26] != b"\x9d\x01\x2a":
        return None
    width, height = struct.unpack("<HH", data[26:30])
    return width & 0x3FFF, height & 0x3FFF
