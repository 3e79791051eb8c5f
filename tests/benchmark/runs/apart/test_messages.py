"""What a caller takes from the process of a fit."""

import os
from pathlib import Path

import pytest

from spike4dgs.benchmark import UserError
from spike4dgs.benchmark.files import MOST_BYTES
from spike4dgs.benchmark.runs.apart.messages import read_image
from spike4dgs.benchmark.runs.predictions import MOST_OF_IMAGE


def test_an_image_is_read_and_stays(tmp_path: Path) -> None:
    (tmp_path / "images-0/cam_03").mkdir(parents=True)
    (tmp_path / "images-0/cam_03/000020.exr").write_bytes(b"image")
    assert read_image(tmp_path / "images-0", "cam_03/000020.exr") == b"image"
    assert (tmp_path / "images-0/cam_03/000020.exr").is_file()


def test_an_image_may_be_larger_than_a_text(tmp_path: Path) -> None:
    with open(tmp_path / "a.exr", "wb") as file:
        file.truncate(MOST_BYTES + 1)  # noise of 9 Mpx in half floats
    assert len(read_image(tmp_path, "a.exr")) == MOST_BYTES + 1
    os.truncate(tmp_path / "a.exr", MOST_OF_IMAGE + 1)
    with pytest.raises(UserError, match=f"{MOST_OF_IMAGE} bytes at most, found {MOST_OF_IMAGE + 1};"):
        read_image(tmp_path, "a.exr")


@pytest.mark.parametrize("linked", ["images-0", "images-0/cam_03", "images-0/cam_03/000020.exr", "FIFO", "nothing"])
def test_what_is_behind_a_link_is_not_read(tmp_path: Path, linked: str) -> None:
    truth, image = tmp_path / "scene", tmp_path / "images-0/cam_03/000020.exr"
    (truth / "cam_03").mkdir(parents=True)
    (truth / "cam_03/000020.exr").write_bytes(b"truth")
    if linked == "FIFO":
        image.parent.mkdir(parents=True)
        os.mkfifo(image)
    elif linked != "nothing":
        (tmp_path / linked).parent.mkdir(parents=True, exist_ok=True)
        inner = Path(linked).parts[1:]
        (tmp_path / linked).symlink_to(truth.joinpath(*inner))
        assert image.read_bytes() == b"truth"
    with pytest.raises(UserError, match="expected an image of a target, found none"):
        read_image(tmp_path / "images-0", "cam_03/000020.exr")
    assert (truth / "cam_03/000020.exr").read_bytes() == b"truth"
