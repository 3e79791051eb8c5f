"""Launches of split light are recorded once and replayed: what the record keeps of the scene follows the motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from built_worlds import built

from spike4dgs.generators.profiles import SPLIT_PROFILES
from spike4dgs.generators.rendering.mitsuba_variant import load_mitsuba
from spike4dgs.generators.rendering.split_render import SplitRenderer
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import Deforming, Part, WorldScene
from spike4dgs.generators.worlds.meshes import merge, quad, surface
from spike4dgs.generators.worlds.surfaces import Material

WIDTH, HEIGHT, SPP, T_S = 64, 40, 32, 0.0113
LENS = (-0.1, 0.01, 0.0, 0.0, 0.0)


def of_all_kinds() -> WorldScene:
    """The turning disc, whose surfaces are rigid, and over it a smooth sheet that bends and flat tiles that part."""
    side = np.linspace(-0.25, 0.25, 9)
    x, y = np.meshgrid(side, side, indexing="ij")

    def sheet(t_s: float) -> np.ndarray:
        return np.stack([x - 0.3, y, 0.35 + 0.1 * np.sin(8 * x + 100 * t_s)], -1).reshape(-1, 3)

    def tiles(t_s: float) -> np.ndarray:
        corners = np.array([(-0.1, -0.1, 0), (0.1, -0.1, 0), (0.1, 0.1, 0), (-0.1, 0.1, 0)])
        return np.concatenate([corners + (0.3 + way * (0.12 + 2 * t_s), 0, 0.3) for way in (-1, 1)])

    bent = surface(sheet(0.0).reshape(9, 9, 3))
    flat = replace(merge([quad((0, 0, 0), (1, 0, 0), (0, 1, 0))] * 2), smooth=False)
    deforming = {
        "sheet": Deforming(Part(bent, Material((0.7, 0.5, 0.2))), sheet),
        "tiles": Deforming(Part(flat, Material((0.2, 0.5, 0.7))), tiles, np.repeat([0, 1], len(flat.faces) // 2)),
    }
    return replace(built("turntable", 10), deforming=deforming)


@pytest.fixture
def own() -> SplitRenderer:
    if load_mitsuba().variant() != "llvm_ad_rgb":
        pytest.skip("other variants record nothing")
    world = of_all_kinds()
    rig = [replace(camera, distortion=LENS) for camera in cameras(world, WIDTH, HEIGHT, (1, 4))]
    soft = SPLIT_PROFILES["tiny"].soft
    return SplitRenderer(world, rig, seed=0, spp=SPP, background_spp=2 * SPP, soft=soft, psf_px=0.4)


def test_recorded_launches_are_those_that_are_traced_anew(own):
    """What a record keeps of the scene, such as the addresses of vertices, has to follow the motion."""
    import drjit as dr

    ids = own.geometry(T_S, 1e-4)[1]
    assert all((ids == k + 1).sum() > 20 for k in range(len(own.world.object_names))), "every kind of surface is seen"

    def launched(where: np.ndarray, maps: list) -> list[np.ndarray]:
        counts = 2 ** (where % 4 + 1)
        return [
            own._tracer.split(where, counts, where, True, maps),
            own._tracer.spread(where, where, True, maps),
            own._tracer.soft(where, counts, where, True, gloss=False),
            own._tracer.soft(where, 4, where, True, gloss=True),
            own._tracer.split(where, 8, 3, False, maps[:1]),
        ]

    launches = []
    for t_s in (0.004, T_S):  # recorded, and replayed
        inputs = np.flatnonzero(own.traced(t_s)), own._maps_at(t_s)
        own._scene.set_time(t_s)  # once: normals that Mitsuba adds up in threads may differ in the last bit
        launches.append(launched(*inputs))
    recorded, replayed = launches
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        traced = launched(*inputs)
    for found, expected in zip(replayed, traced, strict=True):
        np.testing.assert_array_equal(found, expected)
    assert not np.array_equal(recorded[0], replayed[0])
    assert own._tracer._radiance_of.frozen.n_recordings <= 3 and own._tracer._soft_of.frozen.n_recordings <= 4
