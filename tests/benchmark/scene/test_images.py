"""Image files: what is written is read back, gray and colour; files that are none are refused in one line."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene import images as files

READERS = (files.read_exr, files.read_rgb, files.read_geometry)


def radiance(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).gamma(1.0, 0.5, shape).astype(np.float32)


def geometry(height: int, width: int, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.1, 1e5, (height, width)).astype(np.float32)
    depth[rng.random((height, width)) < 0.2] = np.inf
    ids = rng.integers(0, 2**32, (height, width), dtype=np.uint32)
    return {"depth": depth, "ids": ids, "flow": rng.normal(0, 9, (height, width, 2)).astype(np.float32)}


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 99))
def test_half_floats_come_back(tmp_path_factory: pytest.TempPathFactory, height: int, width: int, seed: int) -> None:
    root = tmp_path_factory.mktemp("exr")
    plain, colour = radiance(height, width, seed=seed), radiance(height, width, 3, seed=seed)
    files.write_exr(root / "gray.exr", plain, 50.0)
    files.write_exr(root / "rgb.exr", colour, 50.0)
    assert np.array_equal(files.read_exr(root / "gray.exr"), plain.astype(np.float16).astype(np.float32))
    assert np.array_equal(files.read_rgb(root / "rgb.exr"), colour.astype(np.float16).astype(np.float32))
    exact = colour.astype(np.float64) @ [0.212671, 0.715160, 0.072169]
    found = files.read_exr(root / "rgb.exr")
    assert found.dtype == np.float32 and found.shape == (height, width)
    assert (np.abs(found - exact) <= 2.0**-11 * exact + 2.0**-24).all(), "half an ulp of a half, from unrounded RGB"


def test_colour_files_are_what_other_programs_read(tmp_path: Path) -> None:
    import OpenEXR

    colour = radiance(9, 13, 3)
    files.write_exr(tmp_path / "a.exr", colour, 1250.0)
    with OpenEXR.File(str(tmp_path / "a.exr")) as f:
        assert set(f.channels()) == {"RGB", "Y"} and f.channels()["RGB"].pixels.dtype == np.float16
        assert np.array_equal(f.channels()["RGB"].pixels, colour.astype(np.float16))
        assert f.header()["t_us"] == 1250.0
    again = tmp_path / "b.exr"
    files.write_exr(again, colour, 1250.0)
    assert again.read_bytes() == (tmp_path / "a.exr").read_bytes(), "same image, same bytes"


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 99))
def test_geometry_comes_back(tmp_path_factory: pytest.TempPathFactory, height: int, width: int, seed: int) -> None:
    path = tmp_path_factory.mktemp("exr") / "new" / "a.exr"
    made = geometry(height, width, seed)
    files.write_geometry(path, **made, t_us=1000.0)
    found = files.read_geometry(path)
    for name, expected in made.items():
        values = getattr(found, name)
        assert values.dtype == expected.dtype and np.array_equal(values, expected)


def test_geometry_channels_have_their_types(tmp_path: Path) -> None:
    import OpenEXR

    files.write_geometry(tmp_path / "a.exr", **geometry(5, 7), t_us=1000.0)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as f:
        types = {name: channel.pixels.dtype.name for name, channel in f.channels().items()}
    assert types == {"Z": "float32", "flow.x": "float32", "flow.y": "float32", "id": "uint32"}


@pytest.mark.parametrize("shape", [(6, 9), (6, 9, 3)])
def test_png_comes_back(tmp_path: Path, shape: tuple[int, ...]) -> None:
    image = files.encode_srgb(radiance(*shape))
    files.write_png(tmp_path / "new/a.png", image)
    with Image.open(tmp_path / "new/a.png") as found:
        assert np.array_equal(np.asarray(found), image)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.png"]


@pytest.mark.parametrize("read", READERS)
def test_missing_and_damaged_files_are_named(tmp_path: Path, read: Callable[[Path], Any]) -> None:
    path = tmp_path / "a.exr"
    with pytest.raises(UserError, match=r"a\.exr: expected an EXR image, found no such file"):
        read(path)
    path.write_bytes(b"not an image")
    with pytest.raises(UserError, match=r"a\.exr: expected an EXR image, found damaged data"):
        read(path)
    if read is files.read_geometry:
        files.write_geometry(path, **geometry(32, 40), t_us=0.0)
    else:
        files.write_exr(path, radiance(32, 40, 3), 0.0)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(UserError, match=r"a\.exr: expected an EXR image, found damaged data") as e:
        read(path)
    assert "\n" not in str(e.value)


def test_one_kind_of_file_is_not_another(tmp_path: Path) -> None:
    files.write_exr(tmp_path / "gray.exr", radiance(4, 5), 0.0)
    files.write_geometry(tmp_path / "geometry.exr", **geometry(4, 5), t_us=0.0)
    with pytest.raises(UserError, match=r"expected a colour image \(channels R, G, B\), found channels \['Y'\]"):
        files.read_rgb(tmp_path / "gray.exr")
    with pytest.raises(UserError, match=r"expected geometry \(channels Z, id, flow.x, flow.y\), found channels \['Y'"):
        files.read_geometry(tmp_path / "gray.exr")
    with pytest.raises(UserError, match=r"expected a gray image \(channel Y\), found channels \['Z'"):
        files.read_exr(tmp_path / "geometry.exr")


@pytest.mark.parametrize(
    ("shape", "value", "message"),
    [
        ((4, 5), np.nan, "expected a finite gray image within"),
        ((4, 5, 3), np.inf, "expected a finite RGB image within"),
        ((4, 5, 3), 7e4, "expected a finite RGB image within"),
        ((4, 5, 2), 1.0, r"found shape \(4, 5, 2\)"),
        ((4,), 1.0, r"found shape \(4,\)"),
    ],
)
def test_images_that_do_not_fit_are_refused(tmp_path: Path, shape: tuple[int, ...], value: float, message: str) -> None:
    with pytest.raises(UserError, match=message):
        files.write_exr(tmp_path / "a.exr", np.full(shape, value, np.float32), 0.0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ids": np.zeros((4, 6), np.uint32)}, r"found \(4, 5\), \(4, 6\), \(4, 5, 2\)"),
        ({"flow": np.zeros((4, 5), np.float32)}, r"expected shapes \(H, W\), \(H, W\), \(H, W, 2\)"),
        ({"flow": np.full((4, 5, 2), np.inf, np.float32)}, "finite flow"),
        ({"depth": np.full((4, 5), np.nan, np.float32)}, "depth that is no NaN"),
    ],
)
def test_geometry_that_is_none_is_refused(tmp_path: Path, change: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(UserError, match=message):
        files.write_geometry(tmp_path / "a.exr", **{**geometry(4, 5), **change}, t_us=0.0)
    assert not list(tmp_path.iterdir())


def test_colours_of_16_bits_are_not_cut_to_8(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "deep.png"), np.full((4, 5, 3), 300, np.uint16))
    with pytest.raises(UserError, match="expected an 8-bit gray or RGB PNG image, found mode RGB, of more bits"):
        files.read_png(tmp_path / "deep.png")
