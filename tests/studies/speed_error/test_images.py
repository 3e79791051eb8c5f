from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from spike4dgs.baselines.images.tfi import tfi_image
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.studies.kit.measurement import Request
from spike4dgs.studies.speed_error.images import half_floats, makers


def test_errors_are_those_against_the_ground_truth(small_scene: Path) -> None:
    scene = open_scene(small_scene)
    by_window, by_maker = makers.run(Request("tiny", 0, "cpu", lambda: small_scene))
    chosen = next(p for p in by_window.points if p.role == "chosen")
    assert chosen.values["ticks"] == 40
    squares = []
    for target in (scene.targets[0], scene.targets[1], scene.targets[2]):
        image = tfi_image(scene.stream(target.camera), target.tick) / scene.radiance_gain
        squares.append(np.mean((np.clip(np.nan_to_num(image), 0, 1) - scene.ground_truth(target)) ** 2))
    tfi = next(p for p in by_maker.points if p.name == "tfi")
    assert math.isclose(tfi.values["rms"], math.sqrt(np.mean(squares)), rel_tol=1e-5)
    assert by_maker.points[0].role == "exact" and by_maker.points[0].values["rms"] == 0


def test_numbers_round_as_their_types_do() -> None:
    request = Request("tiny", 0, "cpu", Path)
    usual = {p.name: p.values for p in next(iter(half_floats.run(request))).points}
    assert 2.0**-13 < usual["half floats"]["relative"] <= 2.0**-11
    assert usual["float32"]["relative"] <= 2.0**-24
    assert usual["8-bit sRGB"]["relative"] > 100 * usual["half floats"]["relative"]
