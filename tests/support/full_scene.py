"""A small scene folder that holds every kind of data: recordings of light and darkness, maps, frames, events, truth."""

from pathlib import Path

import numpy as np
from small_scenes import HEIGHT, WIDTH, write_small_scene

from spike4dgs.benchmark.scene.images import write_geometry, write_png
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.other_sensors import Events, write_events
from spike4dgs.benchmark.spikes.stream import SpikeWriter, pack

FLAT_TICKS, DARK_TICKS = 130, 220  # no multiples of the 50 ticks of a window
_EXTRAS = {
    "ground_truth": {"images": "linear radiance", "sparse_every_ticks": 100},
    "conventional": {"fps": 60, "exposure_s": 1 / 120, "coding": "8-bit sRGB gray"},
    "events": {"threshold": 0.2, "columns": "t (us), x, y, p (1: brighter)"},
    "calibration": {"flat_radiance": 0.7, "flat_ticks": FLAT_TICKS, "dark_ticks": DARK_TICKS},
    "instances": {"1": "wheel"},
}


def write_full_scene(root: Path) -> Path:
    """Write a scene with splits and with every optional folder but sheet and preview."""
    rng = np.random.default_rng(1)
    write_small_scene(root, splits=True, extras=_EXTRAS)
    for i in range(4):
        camera, shape = f"cam_{i:02d}", (HEIGHT, WIDTH)
        for kind, ticks, rate in (("flat", FLAT_TICKS, 0.42), ("dark", DARK_TICKS, 0.004)):
            with SpikeWriter(root / f"calibration/{kind}/{camera}.dat", WIDTH, HEIGHT) as writer:
                writer.write(pack(rng.random((ticks, *shape)) < rate))
        maps = root / f"truth/{camera}.npz"
        maps.parent.mkdir(exist_ok=True)
        np.savez(maps, gain=rng.random(shape, np.float32), dark=rng.random(shape, np.float32))
        write_png(root / f"conventional/{camera}/000000.png", rng.integers(0, 256, shape, np.uint8))
        t = np.sort(rng.integers(0, 4000, 50))
        x, y = rng.integers(0, WIDTH, 50).astype(np.uint16), rng.integers(0, HEIGHT, 50).astype(np.uint16)
        write_events(root / f"events/{camera}.npz", Events(t, x, y, rng.integers(0, 2, 50).astype(np.uint8)))
    depth, ids = np.ones((HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH), np.uint32)
    write_geometry(root / "geometry/cam_03/000020.exr", depth, ids, np.zeros((HEIGHT, WIDTH, 2), np.float32), 1000.0)
    write_manifest(root)
    return root
