"""Training bursts of many variants of the worlds, seen by many rigs, at low resolution.

The format of the shards is in `benchmark.scene.training_bursts`. A shard is a function of its settings alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.runs.executors import executor
from spike4dgs.benchmark.scene.training_bursts import (
    REACH,
    Arrays,
    BurstFacts,
    burst_path,
    open_bursts,
    stack_bursts,
    write_bursts,
)
from spike4dgs.benchmark.spikes.sensor_model import SENSOR
from spike4dgs.benchmark.variants import FIRST_SEASON_VARIANT, FIRST_TRAINING_VARIANT, HIDDEN_VARIANTS
from spike4dgs.generators.profiles import RATE_HZ

if TYPE_CHECKING:
    from spike4dgs.benchmark.scene.cameras import Camera
    from spike4dgs.generators.msdi_data.rigs import BurstRenderer
    from spike4dgs.generators.worlds import World, WorldScene

DURATION_S = 0.1  # of the clips that the instants are drawn from
VIEWS = 9
_NEAREST = 0.35  # of the distance to the target: closer static surfaces block a camera's view
_LEAST_SEEN = 0.5  # least share of a camera's pixels with a surface


@dataclass(frozen=True)
class MakeBursts:
    """What each shard contains.

    Args:
        rigs: Rigs of nine cameras in each training variant; hidden variants have half as many.
        instants: Number of instants of each rig.
        resting: Additional rigs, of many kinds, that each see the world at rest at one instant; hidden variants have
            half as many.
        width: Width of the images in pixels.
        height: Height of the images in pixels.
        spp: Samples per pixel of moving objects, a power of two; the static background gets twice as many.
        seed: Seed of all random numbers.
    """

    rigs: int = 6
    instants: int = 3
    resting: int = 12
    width: int = 104
    height: int = 64
    spp: int = 32
    seed: int = 0

    def facts(self, world: str, variant: int) -> BurstFacts:
        """Return the metadata of a shard. A hidden one needs fewer rigs: it is scored, not used for training."""
        hidden = variant in HIDDEN_VARIANTS
        rigs, resting = (-(-count // 2) if hidden else count for count in (self.rigs, self.resting))
        size = self.width, self.height
        sampling = VIEWS, rigs, self.instants, self.spp
        sensor = SENSOR.radiance_gain, SENSOR.photons_per_spike
        return BurstFacts(world, variant, self.seed, *size, *sampling, *sensor, resting)

    def __call__(self, chunk: tuple[str, int]) -> tuple[BurstFacts, Arrays]:
        """Return the shard's facts and arrays."""
        from spike4dgs.generators.msdi_data.rigs import jittered_cameras
        from spike4dgs.generators.msdi_data.wide_rigs import wide_cameras

        name, variant = chunk
        facts = self.facts(name, variant)
        world = all_worlds()[name].build(self.seed, variant, DURATION_S)
        rng = np.random.default_rng([self.seed, variant, *f"{name} bursts".encode()])
        map_seed = int(rng.integers(1 << 31))
        rigs, backgrounds = [], []
        for _ in range(facts.rigs):
            renderer = self._renderer(world, rng, jittered_cameras)
            rigs.append([renderer.burst(tick, map_seed) for tick in _instants(facts.instants, rng)])
            backgrounds.append((renderer.background, renderer.static_depths()))
        resting = [
            self._renderer(world, rng, wide_cameras).at_rest(_instants(1, rng)[0], map_seed)
            for _ in range(facts.resting)
        ]
        return facts, stack_bursts(rigs, backgrounds, resting)

    def _renderer(
        self, world: WorldScene, rng: np.random.Generator, draw: Callable[..., tuple[Camera, ...]]
    ) -> BurstRenderer:
        """Return a renderer for a rig with a free view; each further attempt is closer to the world's own rig."""
        from spike4dgs.generators.msdi_data.rigs import BurstRenderer

        amount = 1.0
        while True:
            cameras = draw(world, self.width, self.height, rng, amount)
            renderer = BurstRenderer(world, cameras, seed=int(rng.integers(1 << 31)), spp=self.spp)
            away = float(np.linalg.norm(cameras[VIEWS // 2].center - np.array(world.rig.target)))
            depths = renderer.static_depths()
            near = np.quantile(depths, 0.02, axis=(1, 2), method="lower")
            seen = np.isfinite(depths).mean(axis=(1, 2))
            if amount < 0.1 or (near.min() > _NEAREST * away and seen.min() > _LEAST_SEEN):
                return renderer
            amount *= 0.8


def all_worlds() -> dict[str, World]:
    """Return the worlds to train on: the benchmark's and other packages', and those that are for training only."""
    from spike4dgs.generators.msdi_data.clutter import TRAINING_WORLDS
    from spike4dgs.generators.worlds import WORLDS

    return {**{name: WORLDS[name] for name in WORLDS.all_names}, **TRAINING_WORLDS}


def _instants(count: int, rng: np.random.Generator) -> list[int]:
    """Return ticks, one drawn from each of `count` equal parts of the clip."""
    first, last = REACH, round(DURATION_S * RATE_HZ) - REACH
    edges = np.linspace(first, last, count + 1).astype(int)
    return [int(rng.integers(a, b)) for a, b in zip(edges[:-1], edges[1:], strict=True)]


def make_shards(
    out: Path, worlds: Iterable[str], variants: int, make: MakeBursts, workers: int = 1, scheduler: str | None = None
) -> None:
    """Render the shards OUT/WORLD-VARIANT.safetensors that are absent: training variants, and the hidden ones.

    Raises UserError where a shard was made with other settings, and for impossible numbers.
    """
    if min(make.rigs, make.instants) < 1 or min(variants, make.resting) < 0 or min(make.width, make.height) < 16:
        found = f"{variants} variants, {make.rigs} rigs, {make.instants} instants, {make.width}x{make.height}"
        raise problem("make-msdi-data", "counts from 1 up and at least 16x16 pixels", found, "correct them")
    if make.instants > (most := round(DURATION_S * RATE_HZ) - 2 * REACH):
        raise problem("--instants", f"at most {most}, the ticks of a clip", str(make.instants), "give fewer")
    if FIRST_TRAINING_VARIANT + variants > FIRST_SEASON_VARIANT:
        most = FIRST_SEASON_VARIANT - FIRST_TRAINING_VARIANT
        fix = f"variants from {FIRST_SEASON_VARIANT} on are kept for hidden seasons"
        raise problem("--variants", f"at most {most}", str(variants), fix)
    if make.spp < 1 or make.spp & (make.spp - 1):
        raise problem("--spp", "a power of two", str(make.spp), "give 16, 32, 64, ...")
    learned = [*range(FIRST_TRAINING_VARIANT, FIRST_TRAINING_VARIANT + variants)]
    numbers = [*learned[:1], *HIDDEN_VARIANTS, *learned[1:]]  # a training may begin before all are there
    names = list(dict.fromkeys(worlds))
    shards = [(world, variant) for variant in numbers for world in names]
    todo = [shard for shard in shards if not _is_done(out, make.facts(*shard))]
    print(f"{len(shards)} shards, {len(shards) - len(todo)} of them exist", flush=True)
    with executor(workers, scheduler) as run:
        _write_all(run(make, todo), len(todo), out)


def _write_all(made: Iterator[tuple[BurstFacts, Arrays]], count: int, out: Path) -> None:
    start = time.perf_counter()
    for done, (facts, arrays) in enumerate(made, start=1):
        path = burst_path(out, facts.world, facts.variant)
        write_bursts(path, facts, arrays)
        passed = time.perf_counter() - start
        left = passed / done * (count - done)
        size = f"{facts.rigs * facts.instants + facts.resting} bursts, {path.stat().st_size / 1e6:.1f} MB"
        print(f"{facts.id}: {size}, {done}/{count}, {passed:.0f} s, about {left:.0f} s left", flush=True)


def _is_done(out: Path, facts: BurstFacts) -> bool:
    """Return whether the shard exists. Raises UserError where it was made with other settings."""
    path = burst_path(out, facts.world, facts.variant)
    if not path.is_file():
        return False
    if (found := open_bursts(path).facts) != facts:
        raise problem(path, f"a shard with the settings {facts}", str(found), "choose another --out, or remove it")
    return True
