"""The checks: a world, changed so that both renderers have to agree but for one cause."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from spike4dgs.generators.profiles import HELD_OUT_VIEW
from spike4dgs.generators.worlds import WorldScene
from spike4dgs.generators.worlds.base import Part
from spike4dgs.generators.worlds.meshes import Mesh
from spike4dgs.generators.worlds.surfaces import Material
from spike4dgs.studies.second_renderer.export import Coats, SkyMap

Change = Callable[[WorldScene], WorldScene]
_GREY = Material((0.5, 0.5, 0.5))
_BLACK = (0.0, 0.0, 0.0)
_APART_M = 1e-4  # far above the rounding of float32 at 10 m, far below a pixel
_UNIFORM = {"sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.7, 0.7, 0.7]}}}


@dataclass(frozen=True)
class Check:
    """One comparison.

    Attributes:
        id: of its files and its row.
        differs: what the renderers may differ in.
        change: the world that both render.
        ours: id of the check with the same rendering of ours; empty for its own.
        sky, coats: how the second renderer has them.
        views: cameras of the array.
    """

    id: str
    differs: str
    change: Change
    ours: str = ""
    sky: SkyMap = "as ours"
    coats: Coats = "layered"
    views: tuple[int, ...] = (HELD_OUT_VIEW,)

    def applies(self, world: WorldScene) -> bool:
        """Return whether the world has what the check is about."""
        return self.sky == "as ours" or any(spec["type"] == "envmap" for spec in world.emitters.values())


def dressed(world: WorldScene, change: Callable[[Part], Part]) -> WorldScene:
    """Return a world with other surfaces."""
    return replace(
        world,
        static={name: change(part) for name, part in world.static.items()},
        groups={name: tuple(change(part) for part in group) for name, group in world.groups.items()},
        deforming={name: replace(d, part=change(d.part)) for name, d in world.deforming.items()},
    )


def _flat(mesh: Mesh) -> Mesh:
    return replace(mesh, smooth=False)


def _apart(mesh: Mesh) -> Mesh:
    """Return flat faces of which no two connected pieces lie in one plane: each is moved by some 0.1 mm."""
    first, second, third = mesh.faces.T
    edges = np.concatenate([first, second]), np.concatenate([second, third])
    count, piece = connected_components(coo_matrix((np.ones(len(edges[0])), edges), [len(mesh.vertices)] * 2))
    shifts = np.random.default_rng([count, len(mesh.vertices)]).normal(0, _APART_M, (count, 3))
    return replace(mesh, vertices=mesh.vertices + shifts[piece], smooth=False)


def _bare(material: Material) -> Material:
    """Return a coat or metal without a matte part; matte surfaces stay."""
    return material if material.gloss is None or material.metal else replace(material, albedo=_BLACK)


def plain(world: WorldScene) -> WorldScene:
    """Return a world of grey matte flat faces, of which no two lie in one plane."""
    return dressed(world, lambda part: Part(_apart(part.mesh), _GREY))


def flush(world: WorldScene) -> WorldScene:
    """Return a world of grey matte flat faces in their places."""
    return dressed(world, lambda part: Part(_flat(part.mesh), _GREY))


def smooth(world: WorldScene) -> WorldScene:
    """Return a world of grey matte surfaces with their interpolated normals."""
    return dressed(world, lambda part: Part(part.mesh, _GREY))


def textured(world: WorldScene) -> WorldScene:
    """Return a world of matte flat faces with their textures."""
    return dressed(world, lambda part: Part(_apart(part.mesh), Material(part.material.albedo)))


def glossy(world: WorldScene) -> WorldScene:
    """Return a world of flat faces whose coats lie over black."""
    return dressed(world, lambda part: Part(_apart(part.mesh), _bare(part.material)))


def overcast(world: WorldScene) -> WorldScene:
    """Return a world of flat faces with their materials, in uniform light."""
    flat = dressed(world, lambda part: Part(_apart(part.mesh), part.material))
    return replace(flat, emitters=_UNIFORM, shadow_sources=np.zeros((0, 4)))


def unchanged(world: WorldScene) -> WorldScene:
    """Return the world itself."""
    return world


BOTH = (HELD_OUT_VIEW, 0)  # and a corner of the array
WHOLE, NATIVE, PLAIN = "world", "native", "grey"
CHECKS = (
    Check(PLAIN, "nothing: grey matte flat faces, none in the plane of another", plain),
    Check("flush", "faces that lie in one plane", flush),
    Check("sky", "where a texel of the sky is", plain, ours=PLAIN, sky="by texel centres"),
    Check("normals", "interpolated normals, and faces in one plane", smooth),
    Check("textures", "filtering of textures", textured),
    Check("gloss", "gloss of coats and metal; coats over black", glossy),
    Check("uniform", "matte light under coats, uniform light", overcast),
    Check(WHOLE, "all, with the nearest coat", unchanged, views=BOTH),
    Check(NATIVE, "all, with its own coat", unchanged, ours=WHOLE, coats="principled"),
)
