import math
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.studies.kit.measurement import Request
from spike4dgs.studies.speed_error.images import windows


def test_errors_are_those_against_the_ground_truth(small_scene: Path) -> None:
    scene = open_scene(small_scene)
    (found,) = windows.run(Request("tiny", 0, lambda: small_scene))
    chosen = next(p for p in found.points if p.role == "chosen")
    assert chosen.values["ticks"] == 40
    squares = []
    for target in scene.targets[:3]:
        rate = scene.stream(target.camera).window(0, 80)[target.tick - 20 : target.tick + 20].mean(0)
        image = rate / scene.radiance_gain
        squares.append(np.mean((np.clip(image, 0, 1) - scene.ground_truth(target)) ** 2))
    assert math.isclose(chosen.values["rms"], math.sqrt(np.mean(squares)), rel_tol=1e-5)
    assert found.points[0].role == "exact" and found.points[0].values["rms"] == 0
