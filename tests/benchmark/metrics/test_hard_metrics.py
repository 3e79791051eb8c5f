"""Hard inputs of the metrics: constant, equal, almost equal, HDR, black, tiny and broken images."""

import math
from collections.abc import Callable
from copy import deepcopy
from functools import partial

import cv2
import numpy as np
import pytest
import torch
from flip_evaluator import evaluate
from hard_case import REFUSAL, HardCase
from numpy.typing import NDArray

from spike4dgs.benchmark.metrics.flip import flip
from spike4dgs.benchmark.metrics.image_pair import Image, ImagePair, check_images
from spike4dgs.benchmark.metrics.lpips import LpipsNetwork, empty_trunk, make_network
from spike4dgs.benchmark.metrics.measure import Values, fit_gain, measure
from spike4dgs.benchmark.metrics.metric import MAX_PSNR_DB
from spike4dgs.benchmark.metrics.ssim_window import SSIM_SIGMA, SSIM_WINDOW
from spike4dgs.benchmark.metrics.table import METRICS

Float64 = NDArray[np.float64]
_SIZE = (48, 64)

Pair = Callable[[np.random.Generator], tuple[Image, Image]]


def _texture(rng: np.random.Generator) -> Float64:
    """Return a smooth random image in 0..1."""
    smooth = cv2.GaussianBlur(rng.random(_SIZE), (0, 0), 3)
    return np.asarray((smooth - smooth.min()) / np.ptp(smooth), np.float64)


def _noise(rng: np.random.Generator) -> Float64:
    return 2 * rng.random(_SIZE) - 1


def _even(level: float) -> Float64:
    return np.full(_SIZE, level)


def _values(truth: NDArray[np.floating], prediction: NDArray[np.floating], moving: Float64 | None = None) -> Values:
    """Return the values of the linear metrics, after the checks that scoring does."""
    region = np.ones(truth.shape, bool) if moving is None else moving.astype(bool)
    check_images(truth, prediction, region, "image")
    linear = [METRICS[name] for name in ("psnr", "ssim", "psnr_dynamic", "ssim_dynamic")]
    return measure(ImagePair(truth, prediction, region, "image"), 1.0, linear).values


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _ssim_map(truth: NDArray[np.floating], prediction: NDArray[np.floating]) -> Float64:
    x, y = (np.clip(np.asarray(i, np.float64), 0, 1) for i in (truth, prediction))

    def blur(image: Float64) -> Float64:
        size = (SSIM_WINDOW, SSIM_WINDOW)
        return np.asarray(cv2.GaussianBlur(image, size, SSIM_SIGMA, borderType=cv2.BORDER_REFLECT), np.float64)

    c1, c2, mx, my = 0.01**2, 0.03**2, blur(x), blur(y)
    vx, vy, cov = blur((x - 0.5) ** 2) - (mx - 0.5) ** 2, blur((y - 0.5) ** 2) - (my - 0.5) ** 2, blur(x * y) - mx * my
    return np.asarray((2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2)))


def _float32_pair(rng: np.random.Generator) -> tuple[Image, Image]:
    image = _texture(rng).astype(np.float32)
    return image, image + np.float32(1e-4)


_PAIRS: dict[str, tuple[str, Pair]] = {
    "equal": ("equal images", lambda rng: (image := _texture(rng), image)),
    "almost-equal": ("images 1e-7 apart", lambda rng: (image := _texture(rng), image + 1e-7)),
    "constant": ("0.5 everywhere against 0.6 everywhere: variances cancel", lambda rng: (_even(0.5), _even(0.6))),
    "black-and-white": ("black against white", lambda rng: (_even(0.0), _even(1.0))),
    "both-black": ("black against black", lambda rng: (_even(0.0), _even(0.0))),
    "negative": ("an image against its negative", lambda rng: (image := _texture(rng), 1 - image)),
    "hdr": ("values from -1e4 to 1e4: clipped to 0..1", lambda rng: (_texture(rng), 1e4 * _noise(rng))),
    "float32": ("float32, 1e-4 apart", _float32_pair),
    "smallest": ("11x11 pixels: one window", lambda rng: (a := _texture(rng)[:11, :11], a[::-1])),
}
each_pair = pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.hard_case(asked=p[0])) for n, p in _PAIRS.items()]
)


@pytest.mark.hard_case(twin="-10 log10(MSE) in float64", unit="dB", tolerance=1e-6)
@each_pair
def test_psnr(hard_case: HardCase, name: str) -> None:
    truth, prediction = _PAIRS[name][1](hard_case.rng())
    a, b = (np.clip(np.float64(x), 0, 1) for x in (truth, prediction))
    mse = float(np.mean((a - b) ** 2))
    expected = min(-10 * math.log10(mse), MAX_PSNR_DB) if mse else MAX_PSNR_DB
    hard_case.close(_number(_values(truth, prediction)["psnr"]), expected)


@pytest.mark.hard_case(twin="the formula of Wang et al. with OpenCV's filter, float64", tolerance=1e-6)
@each_pair
def test_ssim(hard_case: HardCase, name: str) -> None:
    truth, prediction = _PAIRS[name][1](hard_case.rng())
    half = SSIM_WINDOW // 2
    expected = _ssim_map(truth, prediction)[half:-half, half:-half].mean()
    hard_case.close(_number(_values(truth, prediction)["ssim"]), expected)


@pytest.mark.hard_case(
    asked="a moving region of one pixel, and none", twin="float64 formulas", unit="dB", tolerance=1e-9
)
def test_moving_region(hard_case: HardCase) -> None:
    truth = _texture(hard_case.rng())
    prediction, one = 0.9 * truth + 0.02, np.zeros(_SIZE)
    one[7, 9] = 1
    values, none = _values(truth, prediction, one), _values(truth, prediction, 0 * one)
    assert none["psnr_dynamic"] is None and none["ssim_dynamic"] is None, "a value without a moving region"
    expected = [-20 * math.log10(abs(truth[7, 9] - prediction[7, 9])), _ssim_map(truth, prediction)[7, 9]]
    hard_case.close([_number(values["psnr_dynamic"]), _number(values["ssim_dynamic"])], expected)


@pytest.mark.hard_case(
    asked="the gain of a prediction 1e-6 and 1e6 times the truth, of a black one and a negative one",
    twin="numpy.linalg.lstsq; none",
    unit="of the gain",
    tolerance=1e-9,
)
def test_gain(hard_case: HardCase) -> None:
    truth = _texture(hard_case.rng())
    for factor in (1e-6, 1.0, 1e6):
        prediction = factor * (truth + 0.1 * hard_case.rng().random(_SIZE))
        expected = np.linalg.lstsq(prediction.reshape(-1, 1), truth.ravel(), rcond=None)[0][0]
        hard_case.close(_number(fit_gain([(truth, prediction)])) / expected, 1.0, f"{factor:g}")
    taken = [level for level in (0.0, -1.0) if fit_gain([(truth, _even(level))]) is not None]
    assert not taken, "black and negative images have no gain"


@pytest.mark.hard_case(
    asked="FLIP of equal, even, inverted, 1x1 images", twin="the package flip-evaluator", tolerance=2e-4
)
def test_flip(hard_case: HardCase) -> None:
    image = np.rint(255 * _texture(hard_case.rng())).astype(np.uint8)
    even = np.full_like(image, 128)
    pairs = {
        "equal": (image, image),
        "even": (even, even + np.uint8(30)),
        "inverted": (image, 255 - image),
        "black and white": (0 * image, 0 * image + np.uint8(255)),
        "1x1": (image[:1, :1], 255 - image[:1, :1]),
    }
    for name, pair in pairs.items():
        colour = [np.repeat((x / 255).astype(np.float32)[..., None], 3, axis=2) for x in pair]
        expected = evaluate(*colour, "LDR", applyMagma=False)[0].mean(dtype=np.float64)
        hard_case.close(flip(*pair), float(expected), name)


@pytest.mark.hard_case(
    asked="LPIPS of black, white, even and random images, random trunks of three networks",
    twin="the formula in float64, layer by layer",
    unit="relative",
    tolerance=1e-4,
)
def test_lpips(hard_case: HardCase) -> None:
    rng = hard_case.rng()
    black = np.zeros(_SIZE, np.uint8)
    noise = rng.integers(0, 256, _SIZE, dtype=np.uint8)
    pairs = {
        "equal": (noise, noise),
        "black and white": (black, black + np.uint8(255)),
        "black and noise": (black, noise),
        "even": (black + np.uint8(128), black + np.uint8(129)),
    }
    for net in ("alex", "vgg", "squeeze"):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(hard_case.seed)
            trunk = empty_trunk(net).eval()
        network = make_network(net, trunk)
        found = {name: network.distance(*pair) for name, pair in pairs.items()}
        for name, pair in pairs.items():
            hard_case.close(found[name], _lpips_twin(network, *pair), f"{net}, {name}", relative=True)


def _lpips_twin(network: LpipsNetwork, a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    """Return LPIPS with torch's layers and numpy's sums, all in float64."""
    heads, seen = dict(zip(network.taps, network.weights, strict=True)), []
    trunk = deepcopy(network.trunk).double()
    for image in (a, b):
        channels = [(image / 127.5 - 1 - m) / s for m, s in ((-0.03, 0.458), (-0.088, 0.448), (-0.188, 0.45))]
        x, outputs = torch.tensor(np.stack(channels)[None]), []
        with torch.no_grad():
            for i, layer in enumerate(trunk):
                x = layer(x)
                if i in heads:
                    outputs.append((x[0].numpy(), heads[i].double().numpy()))
        seen.append(outputs)
    total = 0.0
    for (f, head), (g, _) in zip(*seen, strict=True):
        f, g = (v / (np.sqrt((v**2).sum(axis=0)) + 1e-10) for v in (f, g))
        total += float((head[:, None, None] * (f - g) ** 2).sum(axis=0).mean())
    return total


@pytest.mark.hard_case(asked="NaN, infinity, integers, another size, 10x64 pixels, no boolean mask", **REFUSAL)
def test_refuse(hard_case: HardCase) -> None:
    truth = _texture(hard_case.rng())
    mask, small = np.ones(_SIZE, bool), np.zeros((10, 64))
    bad = {
        "NaN": (truth, np.where(truth > 0.9, np.nan, truth), mask),
        "infinity": (truth, np.where(truth > 0.9, np.inf, truth), mask),
        "a truth with NaN": (np.where(truth > 0.9, np.nan, truth), truth, mask),
        "integers": (truth, np.zeros(_SIZE, np.uint8), mask),
        "another size": (truth, truth[:, 1:], mask),
        "colour": (truth, np.stack([truth] * 3, axis=-1), mask),
        "10x64 pixels": (small, small, small > 1),
        "a mask of numbers": (truth, truth, truth),
    }
    hard_case.refused({name: partial(check_images, *images, where="image") for name, images in bad.items()})


@pytest.mark.hard_case(
    asked="BRISQUE and NIQE of black, white, gray, HDR-bright and nearly even images",
    twin="the contract: no value where an image shows nothing, else a finite one",
    unit="wrong answers",
)
def test_no_reference(hard_case: HardCase) -> None:
    rng = hard_case.rng()
    shape, ids = (200, 256), ("brisque", "niqe")
    even: dict[str, Float64] = {f"{level:g}": np.full(shape, level) for level in (0.0, 0.5, 1.0, 1e4, -1.0)}
    some = {"noise": rng.random(shape), "one bright pixel": np.zeros(shape), "bright noise": 1e3 * rng.random(shape)}
    some["one bright pixel"][100, 100] = 1.0
    wrong, said = 0, []
    for name, image in (even | some).items():
        region = np.ones(shape, bool)
        found = measure(ImagePair(image, image, region, "image"), 1.0, [METRICS[i] for i in ids])
        for i in ids:
            value = found.values[i]
            if name in even:
                bad = value is not None
            else:  # a refusal with a reason is right too: little is to be seen
                bad = not (math.isfinite(value) if value is not None else found.refused.get(i))
            if bad:
                said.append(f"{i} of {name} is {value}")
            wrong += bad
    hard_case.check(wrong, "; ".join(said) or f"{len(even)} even images refused, {len(some)} others answered")
