"""Options that several commands have."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import arg

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.spikes.image_size import size_doubt
from spike4dgs.benchmark.spikes.stream import SpikeStream

From = Annotated[str | None, arg(name="from")]  # where a release or a weight file is fetched from
SetValues = Annotated[tuple[str, ...], arg(name="set", metavar="PART.NAME=VALUE ...")]  # settings of methods


@dataclass(frozen=True)
class Renderers:
    """What renders.

    Args:
        workers: Processes that render; one uses all cores.
        scheduler: Address of a dask.distributed scheduler, tcp://HOST:PORT, whose workers render.
        device: cpu, cuda (needs an NVIDIA GPU), or auto: the CPU unless SPIKE4DGS_MITSUBA_VARIANT says otherwise.
    """

    workers: int = 1
    scheduler: str | None = None
    device: Literal["auto", "cpu", "cuda"] = "auto"


RENDERERS = Renderers()


@dataclass(frozen=True)
class Compute:
    """What computes, from which random numbers.

    Args:
        device: auto, cpu or cuda.
        seed: Seed of everything random.
    """

    device: str = "auto"
    seed: int = 0


COMPUTE = Compute()


def warn_of_size(streams: Mapping[str, SpikeStream]) -> None:
    """Print a line for each stream whose given size looks wrong."""
    for doubt in filter(None, map(size_doubt, streams.values())):
        print(f"warning: {doubt}", file=sys.stderr)


def check_names(option: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Raise UserError for a name that is not among the known ones."""
    listed = list(known)
    if unknown := [name for name in names if name not in listed]:
        raise problem(option, f"one of {', '.join(listed)}", repr(unknown[0]), "correct the name")
