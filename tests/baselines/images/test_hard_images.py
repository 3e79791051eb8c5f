"""Hard inputs of the image makers: no spike, one spike, all spikes, moving edges, the shortest clips."""

from collections.abc import Callable

import numpy as np
import pytest
from hard_case import BYTES, REFUSAL, HardCase
from numpy.typing import NDArray
from slow_images import slow_adaptive, slow_intervals, slow_tfi, slow_tfp, slow_tfstp, stream_of

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.baselines.images.tfp import TfpSettings
from spike4dgs.benchmark.errors import UserError

Spikes = NDArray[np.uint8]
Float64 = NDArray[np.float64]
_GAIN = 0.6  # spikes per tick of white
_HALF_WINDOW = TfpSettings().half_window
_HEIGHT, _WIDTH, _TICKS = 5, 9, 70  # odd, and as small as slow twins ask


def _none(rng: np.random.Generator) -> Spikes:
    return np.zeros((_TICKS, _HEIGHT, _WIDTH), np.uint8)


def _one(rng: np.random.Generator) -> Spikes:
    """Return pixels with one spike each, anywhere in the clip, its ends among them."""
    spikes = _none(rng)
    at = np.linspace(0, _TICKS - 1, _HEIGHT * _WIDTH).astype(int).reshape(_HEIGHT, _WIDTH)
    np.put_along_axis(spikes, at[None], 1, axis=0)
    return spikes


def _edge(rng: np.random.Generator) -> Spikes:
    """Return spikes of an edge from 0.1 to 0.9 spikes per tick that crosses the image."""
    t, x = np.arange(_TICKS)[:, None, None], np.arange(_WIDTH)[None, None]
    light = np.broadcast_to(np.where(x < _WIDTH * t / _TICKS, 0.9, 0.1), (_TICKS, _HEIGHT, _WIDTH))
    start = rng.random((_HEIGHT, _WIDTH))
    return np.asarray(np.diff(np.floor(start + np.cumsum(light, axis=0)), axis=0, prepend=0) > 0).astype(np.uint8)


def _mixed(rng: np.random.Generator) -> Spikes:
    """Return pixels of all rates from never to always, at random."""
    rate = rng.choice([0, 0.02, 0.1, 0.4, 0.9, 1], (_HEIGHT, _WIDTH))
    return np.asarray(rng.random((_TICKS, _HEIGHT, _WIDTH)) < rate).astype(np.uint8)


_INPUTS: dict[str, tuple[str, Callable[[np.random.Generator], Spikes]]] = {
    "no-spikes": ("a clip without a spike", _none),
    "one-spike": ("one spike a pixel, from the first tick to the last", _one),
    "saturated": ("a spike in every tick", lambda rng: 1 - _none(rng)),
    "edge": ("an edge that moves through the image", _edge),
    "mixed": ("pixels of all rates, random spikes", _mixed),
    "one-tick": ("a clip of one tick", lambda rng: _mixed(rng)[:1]),
}
_TWINS: dict[str, Callable[[Spikes, int], Float64]] = {
    "tfp": lambda spikes, tick: slow_tfp(spikes, tick, _HALF_WINDOW),
    "tfi": slow_tfi,
    "tfstp": slow_tfstp,
    "adaptive": slow_adaptive,
    "intervals": lambda spikes, tick: slow_intervals(spikes, tick)[0],
}
_SHAPE = (64, 96)  # of the networks' images
_LEVELS = {"dark": 0.0, "even": 0.3, "saturated": 1.0}  # spikes per tick


@pytest.mark.hard_case(
    twin="the definition, pixel by pixel, float64 (TFSTP: 50 digits)", unit="of white", tolerance=2e-6
)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=pytest.mark.hard_case(asked=f"{{maker}} of {i[0]}, at its ends and its middle"))
        for n, i in _INPUTS.items()
    ],
)
@pytest.mark.parametrize("maker", _TWINS)
def test_maker(hard_case: HardCase, maker: str, name: str) -> None:
    spikes = _INPUTS[name][1](hard_case.rng())
    n, stream = len(spikes), stream_of(spikes)
    ticks = sorted({0, 1, n // 2, n - 1} & set(range(n)))
    # `intervals` takes the mean over a span where the light changes, which depends on the ticks that are asked for.
    found = (
        [IMAGES[maker](stream, [t], _GAIN)[0] for t in ticks]
        if maker == "intervals"
        else IMAGES[maker](stream, ticks, _GAIN)
    )
    for tick, image in zip(ticks, found, strict=True):
        hard_case.close(image, _TWINS[maker](spikes, tick) / _GAIN, f"tick {tick}")


@pytest.mark.hard_case(
    asked="{maker} of {level} even light", twin="the light that made the spikes, mean over the image", unit="of white",
    tolerance=0.1, on_device=True,  # networks are trained on textured scenes: even light is not among them
)  # fmt: skip
@pytest.mark.parametrize("level", _LEVELS)
@pytest.mark.parametrize("maker", ["spk2img", "msdi"])
def test_network(hard_case: HardCase, maker: str, level: str) -> None:
    rate = _LEVELS[level]
    charge = hard_case.rng().random(_SHAPE) + rate * np.arange(1, 122)[:, None, None]
    spikes = np.diff(np.floor(charge), axis=0).astype(np.uint8)
    try:
        found = IMAGES[maker].on(hard_case.device)(stream_of(spikes), [60], _GAIN)[0]
    except UserError as e:
        pytest.skip(str(e))
    inner = found[8:-8, 8:-8]  # a network has less to see at the border
    hard_case.close(float(inner.mean()) if np.isfinite(found).all() else np.nan, rate / _GAIN)


@pytest.mark.hard_case(asked="ticks -1 and T of every maker", **REFUSAL)
def test_refuse(hard_case: HardCase) -> None:
    stream, calls = stream_of(_mixed(hard_case.rng())), {}
    for name, maker in IMAGES.items():
        for tick in (-1, stream.n_ticks):
            calls[f"{name} at tick {tick}"] = lambda maker=maker, tick=tick: maker(stream, [tick], _GAIN)
    hard_case.refused(calls)


@pytest.mark.hard_case(
    asked="TFP, TFI, TFSTP, adaptive and intervals, 200x125 pixels, on all cores",
    twin="one core",
    **BYTES,
    kind="threads",
)
def test_cores(hard_case: HardCase) -> None:
    stream = stream_of(np.asarray(hard_case.rng().random((200, 125, 200)) < 0.3).astype(np.uint8))
    hard_case.same_on_all_cores(lambda: b"".join(IMAGES[n](stream, [0, 100], _GAIN).tobytes() for n in _TWINS))
