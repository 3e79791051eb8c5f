"""The sheets beside entries: they show what was scored, belong to their entries, and nothing else is taken for one."""

from __future__ import annotations

import hashlib
import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changes import edit_json, files_in
from dummy_methods import CountMethod, run
from PIL import Image
from submissions import edit_with_ledger, enter, entry_of, files_of, read, submit

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.reports.error_map import SCALES
from spike4dgs.benchmark.reports.panels import Box
from spike4dgs.benchmark.scene.images import encode_srgb, read_exr, read_mask
from spike4dgs.leaderboard import entry, thumbnails
from spike4dgs.leaderboard.thumbnails import read_sheet, sheet_path
from spike4dgs.leaderboard.verify_entries import verify_leaderboard

MIDDLE, WIDTH, HEIGHT = "cam_03/000040", 40, 24


def pixels(sheet: Path) -> np.ndarray:
    return np.asarray(Image.open(sheet).convert("L")).astype(float)


def test_the_sheet_shows_what_was_scored_and_the_entry_states_it(done: Path) -> None:
    path = enter(done, "rough")
    stated = read(path)["thumbnails"]
    assert stated["sha256"] == hashlib.sha256(sheet_path(path).read_bytes()).hexdigest()
    assert stated["scenes"].keys() == {"pattern-0", "pattern-1"}
    sheet = pixels(sheet_path(path))
    assert sheet.shape == (2 * HEIGHT, 3 * WIDTH)
    for s in range(2):
        truth = read_exr(done / f"s{s}/images/{MIDDLE}.exr")
        image = read_exr(done / f"out/predictions/rough/pattern-{s}/{MIDDLE}.exr")
        levels = 255 * np.sqrt(np.abs(image.clip(0, 1) - truth.clip(0, 1)).clip(max=0.3) / 0.3)
        row = np.split(sheet[s * HEIGHT : (s + 1) * HEIGHT], 3, axis=1)
        for found, expected, loss in zip(row, (encode_srgb(truth), encode_srgb(image), levels), (3, 3, 9), strict=True):
            assert np.abs(found - expected).mean() < loss and np.corrcoef(found.ravel(), expected.ravel())[0, 1] > 0.95
        own = stated["scenes"][f"pattern-{s}"]
        assert (own["target"], own["width"], own["height"]) == (MIDDLE, WIDTH, HEIGHT) and own["scale"] in SCALES
        assert Box(*own["crop"]).of(read_mask(done / f"s{s}/masks/{MIDDLE}.png")).sum() == HEIGHT * 15, "all that moves"


def test_equal_inputs_give_equal_bytes(done: Path) -> None:
    first = sheet_path(enter(done)).read_bytes()
    (done / "board").rename(done / "earlier")
    assert sheet_path(enter(done)).read_bytes() == first


def test_large_images_are_made_small_with_their_crops(entered: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = read(entry_of(entered))["thumbnails"]["scenes"]["pattern-0"]
    (entered / "board").rename(entered / "earlier")
    monkeypatch.setattr(thumbnails, "LARGEST", 10)
    path = enter(entered)
    own = read(path)["thumbnails"]["scenes"]["pattern-0"]
    assert (own["width"], own["height"]) == (10, 6) and own["scale"] == whole["scale"]
    np.testing.assert_allclose(own["crop"], np.array(whole["crop"]) / 4, atol=1)
    truth = encode_srgb(read_exr(entered / f"s0/images/{MIDDLE}.exr")).astype(float)
    means = truth.reshape(6, 4, 10, 4).mean(axis=(1, 3))
    assert np.abs(pixels(sheet_path(path))[:6, :10] - means).mean() < 6


def test_a_claim_has_no_sheet(done: Path) -> None:
    path = enter(done, verified=False)
    assert "thumbnails" not in read(path) and not sheet_path(path).exists()
    enter(done)
    assert read(path)["thumbnails"]["sha256"] == hashlib.sha256(sheet_path(path).read_bytes()).hexdigest()


def test_a_claim_that_states_a_sheet_is_refused(entered: Path) -> None:
    stated = read(entry_of(entered))["thumbnails"]
    path = enter(entered, "rough", verified=False)
    edit_with_ledger(path, lambda e: e.update(thumbnails=stated))
    with pytest.raises(UserError, match="at verification/label"):
        read(path)


def test_another_record_has_another_sheet(entered: Path) -> None:
    path = entry_of(entered)
    first = sheet_path(path).read_bytes()
    run(entered / "out", [entered / "s0", entered / "s1"], CountMethod("tfp+4dgs", steps=1))
    enter(entered, replace=True)
    second = sheet_path(path).read_bytes()
    assert second != first and read_sheet(sheet_path(path), read(path)["thumbnails"]) == second


def test_the_sheet_of_a_removed_entry_is_found_and_the_next_submission_removes_it(entered: Path, problems: Any) -> None:
    path = entry_of(entered)
    enter(entered, "rough")
    assert problems(entered) == []
    path.unlink()
    line = f"error: {sheet_path(path)}: expected no such file, as no entry states it; remove it"
    assert line in problems(entered)
    enter(entered, "rough")
    (line,) = problems(entered)
    assert not sheet_path(path).exists() and "expected an entry, as LEDGER has a line of it, found none" in line


def test_an_entry_without_its_sheet_gets_it_again_and_keeps_all_else(entered: Path, problems: Any) -> None:
    """Without any, as entries were before sheets, and with one that is not there."""
    path = entry_of(entered)
    before, name = files_in(entered / "board"), path.relative_to(entered / "board").as_posix()
    sheet_path(path).unlink()
    (line,) = problems(entered)
    assert f"{sheet_path(path)}: expected the thumbnails that its entry states, found no such file" in line
    enter(entered, verified=False)
    assert not sheet_path(path).exists()
    enter(entered)
    assert files_in(entered / "board") == before
    sheet_path(path).unlink()
    edit_with_ledger(path, lambda e: e.pop("thumbnails"))
    enter(entered)
    assert files_in(entered / "board")[name] == before[name] and problems(entered) == []


def test_a_killed_submission_leaves_a_sheet_that_blocks_nobody(done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as kill:
        kill.setattr(entry, "write_json", killed)
        with pytest.raises(KeyboardInterrupt):
            enter(done)
    assert [p.name for p in (done / "board").rglob("*tfp+4dgs.*")] == [".tfp+4dgs.next.webp"]
    enter(done, "rough")
    assert not list((done / "board").rglob("tfp+4dgs.*")), "the next submission begins anew"
    path = enter(done)
    assert read_sheet(sheet_path(path), read(path)["thumbnails"])


def test_an_exchanged_sheet_is_found(entered: Path, problems: Any) -> None:
    path, other = entry_of(entered), enter(entered, "rough")
    sheet_path(path).write_bytes(sheet_path(other).read_bytes())
    (line,) = problems(entered)
    stated = read(path)["thumbnails"]["sha256"]
    assert line.startswith(f"error: {sheet_path(path)}: expected sha256 {stated[:16]}... as")


def forged(path: Path, sheet: bytes) -> None:
    """Exchange a sheet as somebody who also knows the entry and the ledger would."""
    sheet_path(path).write_bytes(sheet)
    edit_with_ledger(path, lambda e: e["thumbnails"].update(sha256=hashlib.sha256(sheet).hexdigest()))


def lossy(width: int, height: int) -> bytes:
    """The first bytes of a lossy WebP image that says it has that size."""
    return b"RIFF\0\0\0\0WEBPVP8 \0\0\0\0\0\0\0\x9d\x01\x2a" + struct.pack("<HH", width, height) + b"\0" * 64


def encoded(image: Image.Image, kind: str, **options: int) -> bytes:
    out = io.BytesIO()
    image.save(out, kind, **options)
    return out.getvalue()


PNG = encoded(Image.new("L", (120, 48)), "PNG")


@pytest.mark.parametrize(
    ("content", "found"),
    [(lossy(16383, 16383), "16383x16383"), (lossy(120, 49), "120x49"), (PNG, "another file"), (b"", "another file")],
)
def test_an_image_of_another_size_or_kind_is_no_sheet_whatever_its_hash(
    entered: Path, content: bytes, found: str, problems: Any
) -> None:
    forged(entry_of(entered), content)
    (line,) = [line for line in problems(entered) if "leaderboard.json" not in line]
    assert f"expected a lossy WebP image of 120x48 pixels, found {found};" in line


def test_a_large_file_is_not_read(entered: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = entry_of(entered)
    monkeypatch.setattr(thumbnails, "MOST_BYTES", 100)
    with pytest.raises(UserError, match="100 bytes at most"):
        read_sheet(sheet_path(path), json.loads(path.read_text())["thumbnails"])


def test_an_edit_of_what_the_sheet_shows_is_an_edit_of_the_entry(entered: Path) -> None:
    path = entry_of(entered)
    edit_json(path, lambda e: e["thumbnails"]["scenes"]["pattern-0"].update(target="cam_03/000020"))
    with pytest.raises(UserError, match="expected an entry as LEDGER lists it"):
        read(path)


def test_a_sheet_that_shows_other_images_is_found_where_the_entry_is_scored_again(entered: Path) -> None:
    path = entry_of(entered)
    honest = sheet_path(path).read_bytes()
    image = Image.open(sheet_path(path)).convert("L")
    other = np.array(image)
    other[30:40, 50:60] = 255 - other[30:40, 50:60]

    def found() -> list[str]:
        submit(entered / "out/results/bad.json", leaderboard=entered / "board")  # writes the boards anew
        assert not verify_leaderboard(entered / "board").problems
        return list(verify_leaderboard(entered / "board", **files_of(entered)).problems)

    forged(path, encoded(image.convert("RGB"), "WEBP", quality=40))
    assert found() == [], "another encoder"
    forged(path, encoded(Image.fromarray(other).convert("RGB"), "WEBP", quality=90))
    (line,) = found()
    assert line.startswith(f"{sheet_path(path)}: expected the images that were scored, found others, by ")
    forged(path, honest[:200] + b"\0" * (len(honest) - 200))
    (line,) = found()
    assert line.startswith(f"{sheet_path(path)}: expected")
    enter(entered)
    assert sheet_path(path).read_bytes() != honest, "it is as its entry states"
    enter(entered, replace=True)
    assert sheet_path(path).read_bytes() == honest and found() == []
    edit_with_ledger(path, lambda e: e["thumbnails"]["scenes"]["pattern-0"].update(target="cam_03/000020"))
    (line,) = found()
    assert "expected thumbnails of pattern-0 cam_03/000040 40x24, pattern-1 cam_03/000040 40x24, found" in line
