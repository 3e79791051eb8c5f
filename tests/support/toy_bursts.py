"""Files of training bursts without a renderer: the toy world in nine cameras, in the format of `make-msdi-data`."""

from pathlib import Path

import numpy as np
from toy_world import GAIN, ToyWorld

from spike4dgs.benchmark.scene.training_bursts import Burst, BurstFacts, burst_path, stack_bursts, write_bursts


def toy_burst(world: ToyWorld, t: float, count: int = 3) -> Burst:
    """Return `count` images around `t` in [0, 1]; the pixels of the board at any of these times count as moving."""
    times = t + np.linspace(-0.05, 0.05, count)
    traced = [[world.trace(camera, when) for camera in world.cameras] for when in times]
    keys = np.array([[image for image, _, _ in row] for row in traced], np.float32)
    shape = keys.shape[1:]
    rng = np.random.default_rng(world.seed)
    return Burst(
        keys=keys,
        depth=np.array([depth for _, depth, _ in traced[count // 2]], np.float32),
        moving=np.any([[board for _, _, board in row] for row in traced], axis=0),
        w2c=np.stack([c.w2c for c in world.cameras]),
        K=np.stack([c.K for c in world.cameras]),
        gain=rng.uniform(0.95, 1.05, shape).astype(np.float32),
        dark=rng.uniform(0.001, 0.008, shape).astype(np.float32),
    )


def write_toy_shard(
    folder: Path, variant: int, *, width: int = 32, height: int = 24, instants: int = 2, resting: int = 0, side: int = 3
) -> Path:
    """Write the shard `toy-VARIANT` of one rig and return its path; it sees the world at rest too, `resting` times."""
    world = ToyWorld(width=width, height=height, side=side, seed=variant)
    bursts = [toy_burst(world, t) for t in np.linspace(0.3, 0.7, instants)]
    traced = [world.trace(camera, 1e3) for camera in world.cameras]  # the board is far outside all images
    static = [tuple(np.array([maps[k] for maps in traced], np.float32) for k in range(2))]
    sizes = width, height, len(world.cameras), 1, instants
    facts = BurstFacts("toy", variant, 0, *sizes, 1, GAIN, 5e4, resting)
    path = burst_path(folder, "toy", variant)
    write_bursts(path, facts, stack_bursts([bursts], static, bursts[:1] * resting))
    return path
