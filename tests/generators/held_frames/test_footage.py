"""Footage of cameras: what is found, in which order, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.held_frames.footage import _natural, find_footage, read_frames

WIDTH, HEIGHT = 32, 16


def write_images(folder: Path, values: list[int]) -> None:
    folder.mkdir(parents=True)
    for k, value in enumerate(values):
        Image.new("L", (WIDTH, HEIGHT), value).save(folder / f"img_{k}.png")


def test_images_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    values = [10 * k for k in range(12)]  # img_10 after img_9
    write_images(tmp_path / "left", values)
    write_images(tmp_path / "right", values)
    (tmp_path / "notes.txt").write_text("no footage")
    found = find_footage(tmp_path)
    assert sorted(found) == ["left", "right"]
    footage = found["left"]
    assert (footage.frames, footage.width, footage.height) == (12, WIDTH, HEIGHT)
    assert [int(image[0, 0]) for image in read_frames(footage, [0, 2, 11])] == [0, 20, 110]


def test_images_of_equal_numbers_come_in_one_order() -> None:
    names = [Path("01.png"), Path("1.png"), Path("02.png")]
    assert sorted(names, key=_natural) == sorted(names[::-1], key=_natural) == names


def test_a_video_gives_the_frames_that_are_asked_for_in_rgb(tmp_path: Path) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "cam_0.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 30, (64, 48))
    for k in range(6):
        writer.write(np.full((48, 64, 3), (200, 30 * k, 20), np.uint8))  # blue, green, red
    writer.release()
    footage = find_footage(tmp_path)["cam_0"]
    assert (footage.frames, footage.width, footage.height) == (6, 64, 48)
    one, four = read_frames(footage, [1, 4])
    for image, green in ((one, 30), (four, 120)):
        assert np.abs(image.mean((0, 1)) - (20, green, 200)).max() < 6  # JPEG's colours


def test_colour_and_palette_images_are_rgb(tmp_path: Path) -> None:
    colour = Image.new("RGB", (WIDTH, HEIGHT), (10, 20, 30))
    (tmp_path / "a").mkdir()
    colour.save(tmp_path / "a/0.png")
    colour.quantize().save(tmp_path / "a/1.png")
    first, second = read_frames(find_footage(tmp_path)["a"], [0, 1])
    assert first.shape == (HEIGHT, WIDTH, 3) and (first == (10, 20, 30)).all() and (second == first).all()


def test_a_jpeg_with_a_preview_is_its_first_image(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    image, preview = (Image.new("RGB", (WIDTH // k, HEIGHT // k), (60 * k, 60, 60)) for k in (1, 2))
    image.save(tmp_path / "a/0.jpg", format="MPO", save_all=True, append_images=[preview])
    (read,) = read_frames(find_footage(tmp_path)["a"], [0])
    assert read.shape == (HEIGHT, WIDTH, 3) and np.abs(read - 60.0).max() < 3


def other_size(folder: Path) -> None:
    for path in (folder / "cam_1").iterdir():
        Image.new("L", (WIDTH, HEIGHT + 1)).save(path)


def colour(name: str) -> Callable[[Path], object]:
    """Put an image of 16 bits a channel in the place of the first one."""

    def change(folder: Path) -> None:
        (folder / "cam_1/img_0.png").unlink()
        cv2.imwrite(str(folder / "cam_1" / name), np.full((HEIGHT, WIDTH, 3), 300, np.uint16))

    return change


def upside_down(folder: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.new("L", (WIDTH, HEIGHT)).save(folder / "cam_1/img_0.png", exif=exif)


def pages(folder: Path) -> None:
    (folder / "cam_1/img_0.png").unlink()
    page = Image.new("L", (WIDTH, HEIGHT))
    page.save(folder / "cam_1/img_0.tiff", save_all=True, append_images=[page] * 4)


WIDE = Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint16))
REFUSED: dict[str, tuple[Callable[[Path], object], str]] = {
    "damaged": (lambda f: (f / "cam_1/img_0.png").write_bytes(b"no image"), "an image"),
    "another size": (other_size, "one size for all cameras"),
    "another length": (lambda f: (f / "cam_1/img_1.png").unlink(), "the same number of frames"),
    "16 bits": (lambda f: WIDE.save(f / "cam_1/img_0.png"), "8 bits a channel"),
    "16 bits of colour": (colour("img_0.png"), "8 bits a channel, found mode RGB, of more bits"),
    "16 bits of colour in a TIFF": (colour("img_0.tiff"), "8 bits a channel, found mode RGB, of more bits"),
    "turned by its EXIF data": (upside_down, "an image that is stored upright, found EXIF orientation 3"),
    "pages of one file": (pages, "a file for each frame, found 5 frames in one"),
    "a camera twice": (lambda f: (f / "cam_1.mp4").write_bytes(b"no video"), "a video"),
    "no video": (lambda f: (f / "cam_2.mp4").write_bytes(b"no video"), "a video"),
    "an odd name": (lambda f: (f / "cam_1").rename(f / "cam 1!"), "the id of a camera"),
    "nothing": (lambda f: [path.unlink() for path in f.glob("*/*")], "a subfolder of images, or a video"),
}


@pytest.mark.parametrize(("change", "expected"), REFUSED.values(), ids=REFUSED)
def test_other_footage_is_refused(tmp_path: Path, change: Callable[[Path], object], expected: str) -> None:
    for camera in ("cam_0", "cam_1"):
        write_images(tmp_path / camera, [0, 100])
    change(tmp_path)
    with pytest.raises(UserError, match=expected) as caught:
        find_footage(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_frame_of_another_size_is_refused_when_it_is_read(tmp_path: Path) -> None:
    write_images(tmp_path / "cam_0", [0, 100])
    Image.new("L", (WIDTH + 2, HEIGHT)).save(tmp_path / "cam_0/img_1.png")
    footage = find_footage(tmp_path)["cam_0"]
    with pytest.raises(UserError, match=f"img_1.png: expected frames of {WIDTH}x{HEIGHT} pixels"):
        list(read_frames(footage, [0, 1]))
