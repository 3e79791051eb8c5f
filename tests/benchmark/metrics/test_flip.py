import math

import cv2
import numpy as np
import pytest
from flip_evaluator import evaluate
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics import flip as module
from spike4dgs.benchmark.metrics.flip import flip


def package(truth: UInt8, prediction: UInt8) -> float:
    """The authors' package on the images repeated to three channels. The mean is ours: theirs is summed in float32."""
    channels = [np.repeat((image / 255).astype(np.float32)[..., None], 3, axis=2) for image in (truth, prediction)]
    errors, _, used = evaluate(*channels, "LDR", applyMagma=False)
    assert used["ppd"] == pytest.approx(module.PIXELS_PER_DEGREE, rel=1e-6)
    return float(errors.mean(dtype=np.float64))


def texture(height: int = 40, width: int = 60, seed: int = 0) -> UInt8:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).random((height, width)), (0, 0), 3)
    return np.uint8(np.rint(255 * (noise - noise.min()) / np.ptp(noise)))


def noisy(image: UInt8, sigma: float, seed: int = 1) -> UInt8:
    noise = sigma * np.random.default_rng(seed).standard_normal(image.shape)
    return np.uint8(np.clip(image + noise, 0, 255))


IMAGE = texture()
CASES = {
    "noise": noisy(IMAGE, 12),
    "strong noise": noisy(IMAGE, 80),
    "black": np.zeros_like(IMAGE),
    "white": np.full_like(IMAGE, 255),
    "negative": 255 - IMAGE,
    "dark": IMAGE // 4,
    "moved": np.roll(IMAGE, 2, axis=1),
    "blurred": cv2.GaussianBlur(IMAGE, (0, 0), 2),
    "edge": np.where(np.arange(60) < 30, IMAGE, 255 - IMAGE).astype(np.uint8),
}


@pytest.mark.parametrize("case", CASES)
def test_equals_the_authors_package(case: str) -> None:
    assert flip(IMAGE, CASES[case]) == pytest.approx(package(IMAGE, CASES[case]), abs=5e-6)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 99), height=st.integers(1, 30), width=st.integers(1, 30), sigma=st.floats(0, 200))
def test_equals_the_authors_package_on_all_sizes(seed: int, height: int, width: int, sigma: float) -> None:
    image = np.random.default_rng(seed).integers(0, 256, (height, width), dtype=np.uint8)
    tolerance = 5e-6 if image.size >= 9 else 2e-4  # the package's float32: in a few pixels it does not average out
    assert flip(image, noisy(image, sigma)) == pytest.approx(package(image, noisy(image, sigma)), abs=tolerance)


def test_equal_images_have_no_error_and_the_order_does_not_matter() -> None:
    assert flip(IMAGE, IMAGE) == 0.0
    assert flip(IMAGE, CASES["noise"]) == flip(CASES["noise"], IMAGE)


def test_even_gray_gives_the_closed_form() -> None:
    """Without edges and points only the colour term is left: the lightness difference, compressed."""

    def lightness(level: int) -> float:
        light = ((level / 255 + 0.055) / 1.055) ** 2.4
        return 116 * light ** (1 / 3) - 16

    flat = [np.full((25, 25), level, np.uint8) for level in (200, 190)]
    largest = module._LARGEST**0.7
    expected = 0.95 / (0.4 * largest) * (lightness(200) - lightness(190)) ** 0.7
    assert flip(*flat) == pytest.approx(expected, abs=1e-7)  # the detectors' 1e-16 comes as its root


def test_the_largest_difference_is_that_of_green_and_blue() -> None:
    to_xyz = np.array(
        [
            [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
            [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
            [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
        ]
    )  # of linear sRGB, as rational numbers

    def hunt(rgb: list[float]) -> NDArray[np.float64]:
        ratio = to_xyz @ rgb / to_xyz.sum(1)
        f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio * (29 / 6) ** 2 / 3 + 4 / 29)
        lightness = 116 * f[1] - 16
        return np.array([lightness, 5 * lightness * (f[0] - f[1]), 2 * lightness * (f[1] - f[2])])

    green, blue = hunt([0, 1, 0]), hunt([0, 0, 1])
    distance = abs(green[0] - blue[0]) + math.hypot(*(green - blue)[1:])
    assert distance == pytest.approx(module._LARGEST, abs=1e-6)


@pytest.mark.parametrize(
    "images",
    [(IMAGE, IMAGE[:-1]), (IMAGE / 255, IMAGE / 255), (IMAGE[..., None], IMAGE[..., None]), (IMAGE[:0], IMAGE[:0])],
)
def test_other_images_are_refused(images: tuple[NDArray, NDArray]) -> None:
    with pytest.raises(UserError, match="FLIP: expected two 8-bit gray images of one size, found"):
        flip(*images)
