"""From a world's plain data to Mitsuba's scene objects."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from spike4dgs.generators.mitsuba_variant import load_mitsuba
from spike4dgs.generators.worlds import WorldScene
from spike4dgs.generators.worlds.base import Part
from spike4dgs.generators.worlds.materials import Material, mesh_to_mitsuba

_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)  # Mitsuba's skies are y up
_PLAIN = Material((0.5, 0.5, 0.5))


class Hits(NamedTuple):
    """Where rays meet moving things first. All arrays have one entry per ray."""

    distance: np.ndarray  # float32, along the unit direction; inf: no hit
    thing: np.ndarray  # int32, number of the instance or, after all instances, of the deforming surface; -1: no hit
    face: np.ndarray  # int64, of the mesh that was hit
    uv: np.ndarray  # [N, 2] float64, barycentric weights of the face's second and third corner


class MitsubaScene:
    """A world in Mitsuba's memory: `empty` (what stands still), `movers` (what moves, without materials), `full`.

    `full` and `movers` are at the last pose that `place` was asked for.
    """

    def __init__(self, world: WorldScene) -> None:
        mi = load_mitsuba()
        self._world = world
        static = {name: _emitter(spec) for name, spec in world.emitters.items()} | _shapes("static", world.static)
        self.empty = mi.load_dict({"type": "scene", **static})
        self.full = mi.load_dict({"type": "scene", **static, **_movers(world, plain=False)})
        self.movers = mi.load_dict({"type": "scene", **_movers(world, plain=True)})
        self.thing_ids = [*world.instances, *(f"deforming_{name}" for name in world.deforming)]  # of Mitsuba's shapes
        self._parameters = [mi.traverse(scene) for scene in (self.full, self.movers)]
        self._placed_at: float | None = None
        self.place(0.0)

    def place(self, t_s: float) -> None:
        """Move the instances and surfaces of `full` and `movers` to where they are at `t_s` seconds."""
        if t_s == self._placed_at:
            return
        mi = load_mitsuba()
        poses = self._world.poses(t_s)
        vertices = {
            f"deforming_{name}.vertex_positions": np.ascontiguousarray(surface.vertices(t_s), np.float32).ravel()
            for name, surface in self._world.deforming.items()
        }
        for parameters in self._parameters:
            for name, pose in poses.items():
                parameters[f"{name}.to_world"] = mi.Transform4f(mi.ScalarTransform4f(pose))
            for name, positions in vertices.items():
                parameters[name] = positions
            parameters.update()
        self._placed_at = t_s


@lru_cache(maxsize=1)
def mitsuba_scene(world: WorldScene) -> MitsubaScene:
    """The scene of a world; the last one is kept, because every scene in memory makes Mitsuba's kernels larger."""
    return MitsubaScene(world)


def _movers(world: WorldScene, plain: bool) -> dict[str, Any]:
    """Shape groups, instances and deforming meshes; `plain`: all of one material, where only hits matter."""

    def dressed(part: Part) -> Part:
        return Part(part.mesh, _PLAIN) if plain else part

    moving: dict[str, Any] = {}
    for group, parts in world.groups.items():
        members = _shapes(group, {str(k): dressed(part) for k, part in enumerate(parts)})
        moving[f"group_{group}"] = {"type": "shapegroup", **members}
    for name, group in world.instances.items():
        moving[name] = {"type": "instance", "shapes": {"type": "ref", "id": f"group_{group}"}}
    return moving | _shapes("deforming", {name: dressed(s.part) for name, s in world.deforming.items()})


def _shapes(prefix: str, parts: Mapping[str, Part]) -> dict[str, Any]:
    return {f"{prefix}_{name}": mesh_to_mitsuba(f"{prefix}_{name}", *part) for name, part in parts.items()}


def _emitter(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Turns numpy arrays into Mitsuba's bitmaps and transforms; `z_up` stands a sky upright in our world."""
    mi = load_mitsuba()
    out = {key: value for key, value in spec.items() if key != "z_up"}
    if spec.get("z_up"):
        out["to_world"] = mi.ScalarTransform4f(_Z_UP)
    elif "to_world" in spec:
        out["to_world"] = mi.ScalarTransform4f(spec["to_world"])
    if "bitmap" in spec:
        out["bitmap"] = mi.Bitmap(np.ascontiguousarray(spec["bitmap"], np.float32))
    return out
