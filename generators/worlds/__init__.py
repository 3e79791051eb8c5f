"""The worlds that the benchmark renders: every one a function of (seed, variant, duration). One line per world."""

from spike4dgs.generators.worlds import bicycle, car, jaywalk, motor, turntable
from spike4dgs.generators.worlds.base import Deforming, Part, RigSpec, World, WorldScene

__all__ = ["WORLDS", "Deforming", "Part", "RigSpec", "World", "WorldScene"]

WORLDS: dict[str, World] = {
    world.name: world for world in (jaywalk.WORLD, bicycle.WORLD, motor.WORLD, car.WORLD, turntable.WORLD)
}
