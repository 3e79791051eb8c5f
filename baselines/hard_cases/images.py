"""Hard cases of the image makers: no spike, one spike, all spikes, moving edges, the shortest clips."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from spike4dgs.baselines.images.reference import slow_adaptive, slow_intervals, slow_tfi, slow_tfp, slow_tfstp
from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.baselines.images.tfp import TfpSettings
from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.hard_cases.case import Case, NotRunError, Outcome, Setting, compare, refused, worst
from spike4dgs.benchmark.hard_cases.cores import bytes_by_cores
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack

Spikes = NDArray[np.uint8]
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
}
_NETWORKS = ("spk2img", "msdi")
_SHAPE = (64, 96)  # of the networks' images
_NETWORK_TOLERANCE = 0.1  # networks are trained on textured scenes of usual light: even light is not among them


def stream_of(spikes: Spikes) -> SpikeStream:
    """Return a stream of spikes [T, H, W] in memory."""
    return SpikeStream(pack(spikes), spikes.shape[2], spikes.shape[1], 20_000.0)


def cases() -> list[Case]:
    """Return the cases of the image makers."""
    twins = [_twin_case(maker, name) for maker in _TWINS for name in _INPUTS]
    return [
        *twins,
        *(_intervals_case(name) for name in _INPUTS),
        *(_network_case(maker, level) for maker in _NETWORKS for level in ("dark", "even", "saturated")),
        Case(id="baselines/images/refuse", asked="ticks -1 and T of every maker",
             twin="the contract: one clear error each", unit="inputs taken", tolerance=0, run=_refused),
        Case(id="baselines/images/cores", asked="TFP, TFI, TFSTP, adaptive and intervals, 200x125 pixels, on all cores",
             twin="one core", unit="bytes that differ", tolerance=0, run=_cores, kind="threads"),
    ]  # fmt: skip


def _ticks(n: int) -> list[int]:
    return sorted({0, 1, n // 2, n - 1} & set(range(n)))


def _twin_case(maker: str, name: str) -> Case:
    asked, make = _INPUTS[name]

    def run(setting: Setting) -> Outcome:
        spikes = make(setting.rng())
        ticks = _ticks(len(spikes))
        found = IMAGES[maker](stream_of(spikes), ticks, _GAIN)
        return compare(found, np.stack([_TWINS[maker](spikes, t) for t in ticks]) / _GAIN)

    digits = "50 digits" if maker == "tfstp" else "float64"
    return Case(
        id=f"baselines/images/{maker}-{name}",
        asked=f"{maker} of {asked}, at its ends and its middle",
        twin=f"the definition, pixel by pixel, {digits}",
        unit="of white",
        tolerance=2e-6,
        run=run,
    )


def _intervals_case(name: str) -> Case:
    """Return the case of `intervals`: the mean over a span where the light changes, else what `adaptive` gives."""
    asked, make = _INPUTS[name]

    def run(setting: Setting) -> Outcome:
        spikes, maker = make(setting.rng()), IMAGES["intervals"]
        stream, outcomes = stream_of(spikes), {}
        for tick in _ticks(len(spikes)):
            outcomes[f"tick {tick}"] = compare(maker(stream, [tick], _GAIN)[0], slow_intervals(spikes, tick)[0] / _GAIN)
        return worst(outcomes)

    return Case(
        id=f"baselines/images/intervals-{name}",
        asked=f"intervals of {asked}, at its ends and its middle",
        twin="the mean between two spikes, or adaptive where nothing changes, float64",
        unit="of white",
        tolerance=2e-6,
        run=run,
    )


def _network_case(maker: str, level: str) -> Case:
    rate = {"dark": 0.0, "even": 0.3, "saturated": 1.0}[level]

    def run(setting: Setting) -> Outcome:
        height, width = _SHAPE
        charge = setting.rng().random(_SHAPE) + rate * np.arange(1, 122)[:, None, None]
        spikes = np.diff(np.floor(charge), axis=0).astype(np.uint8)
        try:
            made = IMAGES[maker].on(setting.device)
            found = made(stream_of(spikes), [60], _GAIN)[0]
        except UserError as e:
            raise NotRunError(str(e)) from None
        inner = found[8:-8, 8:-8]  # a network has less to see at the border
        return compare(float(inner.mean()) if np.isfinite(found).all() else np.nan, rate / _GAIN)

    return Case(
        id=f"baselines/images/{maker}-{level}",
        asked=f"{maker} of even light of {rate:g} spikes per tick",
        twin="the light that made the spikes, mean over the image",
        unit="of white",
        tolerance=_NETWORK_TOLERANCE,
        run=run,
        on_device=True,
        seconds=1.5,
    )


def _refused(setting: Setting) -> Outcome:
    stream, calls = stream_of(_mixed(setting.rng())), {}
    for name, maker in IMAGES.items():
        for tick in (-1, stream.n_ticks):
            calls[f"{name} at tick {tick}"] = lambda maker=maker, tick=tick: maker(stream, [tick], _GAIN)  # type: ignore[misc]
    return refused(calls)


def _cores(setting: Setting) -> Outcome:
    stream = stream_of(np.asarray(setting.rng().random((200, 125, 200)) < 0.3).astype(np.uint8))
    names = ("tfp", "tfi", "tfstp", "adaptive", "intervals")
    return bytes_by_cores(lambda: b"".join(IMAGES[n](stream, [0, 100], _GAIN).tobytes() for n in names))
