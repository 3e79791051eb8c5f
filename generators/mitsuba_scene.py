"""From a world's plain data to Mitsuba's scene objects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from spike4dgs.generators.mitsuba_variant import load_mitsuba
from spike4dgs.generators.worlds import WorldScene
from spike4dgs.generators.worlds.base import Part
from spike4dgs.generators.worlds.materials import mesh_to_mitsuba

_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)  # Mitsuba's skies are y up


class MitsubaScene:
    """A world in Mitsuba's memory twice: `empty` without the moving instances, `full` with them at the last pose."""

    def __init__(self, world: WorldScene) -> None:
        mi = load_mitsuba()
        self._world = world
        static = {name: _emitter(spec) for name, spec in world.emitters.items()} | _shapes("static", world.static)
        moving: dict[str, Any] = {}
        for group, parts in world.groups.items():
            members = _shapes(group, {str(k): part for k, part in enumerate(parts)})
            moving[f"group_{group}"] = {"type": "shapegroup", **members}
        for name, group in world.instances.items():
            moving[name] = {"type": "instance", "shapes": {"type": "ref", "id": f"group_{group}"}}
        moving |= _shapes("deforming", {name: surface.part for name, surface in world.deforming.items()})
        self.empty = mi.load_dict({"type": "scene", **static})
        self.full = mi.load_dict({"type": "scene", **static, **moving})
        self._parameters = mi.traverse(self.full)
        self._placed_at: float | None = None
        self.place(0.0)

    def place(self, t_s: float) -> None:
        """Move the instances of `full` to their poses at `t_s` seconds."""
        if t_s == self._placed_at:
            return
        mi = load_mitsuba()
        for name, pose in self._world.poses(t_s).items():
            self._parameters[f"{name}.to_world"] = mi.Transform4f(mi.ScalarTransform4f(pose))
        for name, surface in self._world.deforming.items():
            vertices = np.ascontiguousarray(surface.vertices(t_s), np.float32)
            self._parameters[f"deforming_{name}.vertex_positions"] = vertices.ravel()
        self._parameters.update()
        self._placed_at = t_s


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
