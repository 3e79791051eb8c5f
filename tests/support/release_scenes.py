"""Two small scenes with streams of several blocks and, in one, raw recordings of light and darkness."""

import json
from pathlib import Path

import numpy as np
from small_scenes import HEIGHT, WIDTH, write_small_scene

from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.spikes.stream import SpikeWriter, bytes_per_tick

TICKS = 20_000  # 2.4 MB: two whole blocks and a part of one
FLAT_TICKS, DARK_TICKS = 100, 200


def write_release_scenes(folder: Path) -> tuple[Path, ...]:
    """Write pattern-0 and pattern-1; their streams are random, with recordings in pattern-0."""
    roots = []
    for seed in (0, 1):
        facts = {"flat_radiance": 0.7, "flat_ticks": FLAT_TICKS, "dark_ticks": DARK_TICKS}
        root = write_small_scene(folder / f"pattern-{seed}", seed, extras={"calibration": facts} if seed == 0 else None)
        rng = np.random.default_rng(seed)
        for path in sorted((root / "spikes").glob("*.dat")):
            _write(path, TICKS, rng)
            for kind, ticks in (("flat", FLAT_TICKS), ("dark", DARK_TICKS)) if seed == 0 else ():
                _write(root / f"calibration/{kind}/{path.name}", ticks, rng)
        meta = json.loads((root / "scene.json").read_text())
        (root / "scene.json").write_text(json.dumps(meta | {"n_ticks": TICKS}))
        write_manifest(root)
        roots.append(root)
    return tuple(roots)


def _write(path: Path, ticks: int, rng: np.random.Generator) -> None:
    with SpikeWriter(path, WIDTH, HEIGHT) as writer:
        writer.write(rng.integers(0, 256, (ticks, bytes_per_tick(WIDTH, HEIGHT)), np.uint8))
