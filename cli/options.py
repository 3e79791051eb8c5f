"""Options that several commands share, and what they show as white."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from tyro.conf import arg

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import unknown
from spike4dgs.benchmark.spikes.image_size import size_doubt
from spike4dgs.benchmark.spikes.sensor_model import gathered
from spike4dgs.benchmark.spikes.stream import SpikeStream

From = Annotated[str | None, arg(name="from")]  # where a release or a weight file is fetched from
SetValues = Annotated[tuple[str, ...], arg(name="set", metavar="PART.NAME=VALUE ...")]  # settings of methods

WHITE = 99  # percentile of the pixels that is shown white


@dataclass(frozen=True)
class Renderers:
    """Where the rendering runs.

    Args:
        workers: Number of rendering processes; a single one uses all cores.
        scheduler: Address of a dask.distributed scheduler, tcp://HOST:PORT, whose workers render.
        device: cpu, cuda (needs an NVIDIA GPU), or auto: the CPU unless SPIKE4DGS_MITSUBA_VARIANT says otherwise.
    """

    workers: int = 1
    scheduler: str | None = None
    device: Literal["auto", "cpu", "cuda"] = "auto"


RENDERERS = Renderers()


@dataclass(frozen=True)
class Compute:
    """Device and random seed.

    Args:
        device: auto, cpu or cuda.
        seed: Seed of all random numbers.
    """

    device: str = "auto"
    seed: int = 0


COMPUTE = Compute()


def warn_of_size(streams: Mapping[str, SpikeStream]) -> None:
    """Print a line for each stream whose given size looks wrong."""
    for doubt in filter(None, map(size_doubt, streams.values())):
        print(f"warning: {doubt}", file=sys.stderr)


def white_of(rates: Sequence[Float64], streams: Sequence[SpikeStream]) -> float:
    """Return what to show white where nothing says it: the charge per tick that 1 % of all streams' pixels exceed.

    `rates` [H, W] are those of `mean_rate`; makers divide the charge behind them by white. 1 where nothing fired.
    """
    charges = [gathered(rate, s.dead_ticks).ravel() for rate, s in zip(rates, streams, strict=True)]
    return float(np.percentile(np.concatenate(charges), WHITE)) or 1.0


def check_names(option: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Raise UserError for a name that is not among the known ones."""
    listed = list(known)
    if others := [name for name in names if name not in listed]:
        raise unknown(option, others[0], listed)
