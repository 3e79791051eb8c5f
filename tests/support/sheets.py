"""A small scene with the images of some methods, the truth with a known error each, and records of their scores."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from small_scenes import write_small_scene

from spike4dgs.benchmark.scene.images import write_exr
from spike4dgs.benchmark.scene.scene import Scene, open_scene


@dataclass(frozen=True)
class Results:
    """A scene, the folders of its predictions by method, and the records."""

    scene: Scene
    folders: dict[str, Path]
    records: list[dict[str, Any]]


def write_results(root: Path, noise: dict[str, float], failed: dict[str, str] | None = None) -> Results:
    """Write images of methods: the truth with normal noise of so much standard deviation; `failed` has reasons."""
    scene, rng = open_scene(write_small_scene(root / "scene")), np.random.default_rng(1)
    folders, records = {}, []
    for name, sigma in noise.items():
        folders[name] = root / name
        for target in scene.targets:
            truth = scene.ground_truth(target)
            image = (truth + sigma * rng.normal(size=truth.shape)).astype(np.float32)
            write_exr(folders[name] / f"{target.name}.exr", image, 0.0)
        scores = {"psnr": -20 * np.log10(sigma), "psnr_dynamic": -20 * np.log10(sigma) - 1}
        per_image = {t.name: scores for t in scene.targets}
        records.append(record(name, scene.id, {"status": "ok", "per_image": per_image, "error": None}))
    for name, reason in (failed or {}).items():
        folders[name] = root / name
        records.append(record(name, scene.id, {"status": "failed", "per_image": {}, "error": reason}))
    return Results(scene, folders, records)


def record(name: str, scene: str, cell: dict[str, Any]) -> dict[str, Any]:
    """What sheets and plots read of a record."""
    return {"method": {"name": name}, "scenes": {scene: cell}}
