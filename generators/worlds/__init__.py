"""The worlds that the benchmark renders, each a function of (seed, variant, duration): one entry per world."""

from spike4dgs.generators.worlds import bicycle, bird, bricks, car, chips, jaywalk, motor, turntable, van
from spike4dgs.generators.worlds.base import Deforming, Part, RigSpec, World, WorldScene

__all__ = ["WORLDS", "Deforming", "Part", "RigSpec", "World", "WorldScene"]

WORLDS: dict[str, World] = {
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
