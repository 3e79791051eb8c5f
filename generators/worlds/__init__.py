"""The worlds that the benchmark renders, each a function of (seed, variant, duration): one entry per world.

Worlds of other packages come in by the entry-point group `spike4dgs.worlds`: each entry point names a mapping from
world name to `World`. They are loaded when the table is first read.
"""

import re
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.plugins import find_plugins
from spike4dgs.generators.worlds import bicycle, bird, bricks, car, chips, jaywalk, motor, turntable, van
from spike4dgs.generators.worlds.base import Deforming, Part, RigSpec, World, WorldScene, build_at
from spike4dgs.generators.worlds.hard import appear, beads, blank, flash, mirror, rain

__all__ = ["HARD", "OURS", "WORLDS", "Deforming", "Part", "RigSpec", "World", "WorldScene", "build_at"]

GROUP = "spike4dgs.worlds"

OURS: dict[str, World] = {
    world.name: world
    for world in (
        jaywalk.WORLD,
        bicycle.WORLD,
        motor.WORLD,
        car.WORLD,
        van.WORLD,
        bricks.WORLD,
        chips.WORLD,
        turntable.WORLD,
        bird.WORLD,
    )
}

HARD: dict[str, World] = {
    world.name: world for world in (appear.WORLD, beads.WORLD, blank.WORLD, flash.WORLD, mirror.WORLD, rain.WORLD)
}


class Worlds(Mapping[str, World]):
    """The worlds of this package and of all that are installed beside it.

    The benchmark's come first (`OURS`), then those of content that can break a method (`HARD`), which have to be named:
    they are no part of `all_names`.

    Raises UserError where a name is used twice, and where a package cannot be imported or registers something else.
    """

    @cached_property
    def _all(self) -> dict[str, World]:
        found = find_plugins(GROUP, "world", check_world, OURS | HARD)
        return OURS | HARD | {name: plugin.value for name, plugin in found.items()}

    @property
    def all_names(self) -> list[str]:
        """The worlds that a command makes where none is named: all but `HARD`."""
        return [name for name in self if name not in HARD]

    def __getitem__(self, name: str) -> World:
        return self._all[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)


def check_world(name: str, world: Any, source: str) -> None:
    """Raise UserError unless `world` is a `World` of that name, which can be part of a folder's name."""
    where = f"world {name!r} of {source}"
    if not isinstance(world, World):
        raise problem(where, "a World of spike4dgs.generators.worlds", type(world).__name__, "correct the mapping")
    if world.name != name or not re.fullmatch(r"\w+", name, re.ASCII):
        expected = "its own name as the key, of letters, digits and _"
        raise problem(where, expected, f"a world named {world.name!r}", "correct the name")


WORLDS = Worlds()
