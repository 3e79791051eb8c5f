"""Conversion of a world's plain data to Mitsuba's scene objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from spike4dgs.generators.rendering.mitsuba_variant import load_mitsuba
from spike4dgs.generators.worlds import WorldScene
from spike4dgs.generators.worlds.base import Part
from spike4dgs.generators.worlds.meshes import Mesh, merge, vertex_normals
from spike4dgs.generators.worlds.surfaces import Material, mesh_to_mitsuba

_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)  # Mitsuba's skies are y up
_PLAIN = Material((0.5, 0.5, 0.5))
_ALIGNMENT = 64  # bytes, of Dr.Jit's own arrays


def aligned(array: np.ndarray) -> np.ndarray:
    """Return a copy that starts at a multiple of 64 bytes, for Dr.Jit.

    Dr.Jit maps NumPy's memory, and compiles a kernel anew for each pattern of alignments of its inputs. NumPy aligns
    by chance.
    """
    room = np.empty(array.nbytes + _ALIGNMENT, np.uint8)
    start = -room.ctypes.data % _ALIGNMENT
    copy = room[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy


class Hits(NamedTuple):
    """The first hits of rays with moving objects. All arrays have one entry per ray."""

    distance: np.ndarray  # float32, along the unit direction; inf: no hit
    number: np.ndarray  # int32, number of the instance or, after all instances, of the deforming surface; -1: no hit
    face: np.ndarray  # int64, of the mesh that was hit
    uv: np.ndarray  # [N, 2] float64, barycentric weights of the face's second and third corner


class MitsubaScene:
    """A world in Mitsuba's memory: `empty` (static surfaces), `movers` (moving surfaces, without materials), `full`.

    `opaque` is `empty` without glass. `reflectors` are the mirrors alone and the panes alone; None: there are none.

    `full` and `movers` are at the time of the last `set_time`. With `keeps_buffers` their vertices are always in the
    same memory, so that `dr.freeze` may record what reads them. The moving surfaces are a few plain meshes with updated
    vertices, never Mitsuba's instances: every kernel launch visits each instance, and for a figure of a dozen limbs
    that takes longer than tracing its pixels.
    """

    def __init__(self, world: WorldScene) -> None:
        mi = load_mitsuba()
        self._world = world
        lamps = {name: _emitter(spec) for name, spec in world.emitters.items()}
        static = lamps | _shapes("static", _in_palettes(world.static))
        self._batches = _batches(world)
        moving, plain = (
            _shapes("moving", {k: b.part(dress) for k, b in self._batches.items()}) for dress in (True, False)
        )
        self.empty = mi.load_dict({"type": "scene", **static})
        self.full = mi.load_dict({"type": "scene", **static, **moving})
        self.movers = mi.load_dict({"type": "scene", **plain})
        mirrors, panes = (
            {k: p for k, p in world.static.items() if getattr(p.material, kind)} for kind in ("mirror", "glass")
        )
        self.reflectors = [
            mi.load_dict({"type": "scene", **_shapes("plain", some)}) if some else None for some in (mirrors, panes)
        ]
        solid = {k: Part(part.mesh, _PLAIN) for k, part in world.static.items() if k not in panes}  # no light is found
        self.opaque = mi.load_dict({"type": "scene", **lamps, **_shapes("solid", solid)}) if panes else self.empty
        self._parameters = [mi.traverse(scene) for scene in (self.full, self.movers)]
        # of both scenes: a mesh's buffer as NumPy's array and as Mitsuba's, which are the same memory
        self._buffers: list[dict[str, tuple[np.ndarray, Any]]] = [{} for _ in self._parameters]
        self._is_scalar, self.keeps_buffers = (str(mi.variant()).startswith(kind) for kind in ("scalar", "llvm"))
        self._time_s: float | None = None
        self.set_time(0.0)

    @property
    def mover_ids(self) -> list[str]:
        """Mitsuba's names of the shapes of `movers`."""
        return [f"moving_{name}" for name in self._batches]

    def first_faces(self) -> dict[str, int]:
        """Return the position in `moving_faces` of each moving shape's first face, by its name in `mover_ids`."""
        counts = [len(batch.merged.faces) for batch in self._batches.values()]
        return dict(zip(self.mover_ids, np.cumsum([0, *counts]).tolist(), strict=False))

    @property
    def moving_faces(self) -> np.ndarray:
        """The faces [M, 3] int64 of all moving shapes, numbers of `moving_vertices`."""
        meshes = [batch.merged for batch in self._batches.values()]
        first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        faces = [mesh.faces + start for mesh, start in zip(meshes, first, strict=False)]
        return np.concatenate(faces) if faces else np.zeros((0, 3), np.int64)

    def moving_vertices(self, t_s: float) -> np.ndarray:
        """Return the vertices [V, 3] float32 of all moving shapes at a time."""
        turns = self._turns(t_s)
        positions = [batch.at(t_s, turns)[0].reshape(-1, 3) for batch in self._batches.values()]
        return np.concatenate(positions) if positions else np.zeros((0, 3), np.float32)

    def hits(self, distance: np.ndarray, shape: np.ndarray, face: np.ndarray, uv: np.ndarray) -> Hits:
        """Return hits from the index in `mover_ids` of the shape that each ray meets (-1: none), and its face there."""
        numbers = np.full(len(shape), -1, np.int32)
        for number, batch in enumerate(self._batches.values()):
            mine = shape == number
            numbers[mine] = batch.objects[face[mine]]
        return Hits(distance, numbers, face, uv)

    def set_time(self, t_s: float) -> None:
        """Move the moving surfaces of `full` and `movers` to their positions at `t_s` seconds."""
        if t_s == self._time_s:
            return
        turns, positions, normals = self._turns(t_s), {}, {}
        for name, batch in self._batches.items():
            positions[f"moving_{name}.vertex_positions"], own = batch.at(t_s, turns)
            if own is not None:
                normals[f"moving_{name}.vertex_normals"] = own
        # the scalar variants compute their own normals whenever positions are set, so ours have to come after that
        for values in [positions, normals] if self._is_scalar else [positions | normals]:
            self._set(values)
        if self.keeps_buffers:  # normals that Mitsuba computes have a new buffer now
            lacking = [f"moving_{name}.vertex_normals" for name, batch in self._batches.items() if batch.lacks_normals]
            if lacking:
                self._set({name: np.array(self._parameters[0][name]) for name in lacking})
        self._time_s = t_s

    def _set(self, values: Mapping[str, np.ndarray]) -> None:
        """Give the meshes of `full` and `movers` other values; with `keeps_buffers` in the same memory."""
        import drjit as dr

        mi = load_mitsuba()
        if self.keeps_buffers:
            dr.sync_thread()  # a kernel may still read it
        for parameters, buffers in zip(self._parameters, self._buffers, strict=True):
            for name, array in values.items():
                if not self.keeps_buffers:
                    parameters[name] = aligned(array)
                    continue
                if name not in buffers:
                    buffers[name] = (own := aligned(array)), mi.Float(own)
                buffers[name][0][...] = array
                parameters[name] = buffers[name][1]
                parameters.set_dirty(name)  # the same buffer, so nothing else says that it has changed
            parameters.update()

    def _turns(self, t_s: float) -> np.ndarray:
        """Return the poses [instances, 3, 4] at a time."""
        poses = self._world.poses(t_s)
        return np.array([poses[name][:3] for name in self._world.instances]).reshape(-1, 3, 4)


@dataclass(frozen=True, eq=False)
class _Batch:
    """Moving surfaces of one material as one mesh.

    Attributes:
        merged: rest positions, each part in its own coordinates.
        material: of all.
        owner: [N], number of the instance that each vertex belongs to; None for a deforming surface.
        normals: [N, 3] at rest; None where faces are flat, or Mitsuba computes them.
        objects: [M], number of the instance or deforming surface that each face belongs to.
        vertices: of a deforming surface.
    """

    merged: Mesh
    material: Material
    owner: np.ndarray | None
    normals: np.ndarray | None
    objects: np.ndarray
    vertices: Callable[[float], np.ndarray] | None = None

    @property
    def lacks_normals(self) -> bool:
        """True where Mitsuba computes those of a smooth surface."""
        return self.merged.smooth and self.normals is None

    def part(self, dressed: bool) -> Part:
        """Return the mesh, with its material if `dressed`."""
        return Part(self.merged, self.material if dressed else _PLAIN)

    def at(self, t_s: float, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Return flat float32 positions and normals at a time; `turns` [instances, 3, 4] are the poses."""
        if self.vertices is not None:
            return np.ascontiguousarray(self.vertices(t_s), np.float32).ravel(), None
        pose = turns[self.owner]
        positions = np.einsum("nij,nj->ni", pose[:, :, :3], self.merged.vertices) + pose[:, :, 3]
        if self.normals is None:
            return positions.astype(np.float32).ravel(), None
        normals = np.einsum("nij,nj->ni", pose[:, :, :3], self.normals)
        return positions.astype(np.float32).ravel(), normals.astype(np.float32).ravel()


def _batches(world: WorldScene) -> dict[str, _Batch]:
    """Return the moving surfaces of a world; surfaces of equal material and smoothness are merged."""
    alike: dict[tuple[Any, ...], list[tuple[int, Part]]] = {}
    for number, group in enumerate(world.instances.values()):
        for part in world.groups[group]:
            m = part.material
            image = id(m.albedo) if isinstance(m.albedo, np.ndarray) else None
            alike.setdefault((image, m.gloss, m.metal, m.glass, part.mesh.smooth), []).append((number, part))
    found = {}
    for k, members in enumerate(alike.values()):
        numbers, parts = zip(*members, strict=True)
        one = parts[0]
        if not isinstance(one.material.albedo, np.ndarray):
            one = _in_palette(parts)
        else:
            one = Part(merge([part.mesh for part in parts]), one.material)
        normals = np.concatenate([vertex_normals(part.mesh) for part in parts]) if one.mesh.smooth else None
        owner = np.repeat(numbers, [len(part.mesh.vertices) for part in parts])
        objects = np.repeat(numbers, [len(part.mesh.faces) for part in parts])
        found[f"rigid{k}"] = _Batch(one.mesh, one.material, owner, normals, objects)
    for number, (name, surface) in enumerate(world.deforming.items(), start=len(world.instances)):
        objects = np.full(len(surface.part.mesh.faces), number)
        found[name] = _Batch(*surface.part, None, None, objects, surface.vertices)
    return found


@lru_cache(maxsize=1)
def mitsuba_scene(world: WorldScene) -> MitsubaScene:
    """Return the scene of a world. Only the last one is cached: each scene in memory makes Mitsuba's kernels larger."""
    return MitsubaScene(world)


def _shapes(prefix: str, parts: Mapping[str, Part]) -> dict[str, Any]:
    return {f"{prefix}_{name}": mesh_to_mitsuba(f"{prefix}_{name}", *part) for name, part in parts.items()}


def _in_palettes(parts: Mapping[str, Part]) -> dict[str, Part]:
    """Return the same surfaces, but merge plain-coloured ones that reflect alike: fewer materials, less work."""
    kept: dict[str, Part] = {}
    alike: dict[tuple[Any, ...], list[Part]] = {}
    for name, part in parts.items():
        if isinstance(part.material.albedo, np.ndarray):
            kept[name] = part
        else:
            m = part.material
            alike.setdefault((m.gloss, m.metal, m.glass, part.mesh.smooth), []).append(part)
    return kept | {f"plain{number}": _in_palette(members) for number, members in enumerate(alike.values())}


def _in_palette(parts: Sequence[Part]) -> Part:
    """Return surfaces that differ only in their plain colours as one, with these colours in an image of one row."""
    material = parts[0].material
    colours = np.array([part.material.albedo for part in parts], np.float32)[None]  # [1, N, 3]
    meshes = [
        replace(part.mesh, uv=np.tile([(k + 0.5) / len(parts), 0.5], (len(part.mesh.vertices), 1)))
        for k, part in enumerate(parts)
    ]
    return Part(merge(meshes), replace(material, albedo=colours))


def _emitter(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Convert NumPy arrays to Mitsuba's bitmaps and transforms; `z_up` turns a sky upright in our world."""
    mi = load_mitsuba()
    out = {key: value for key, value in spec.items() if key != "z_up"}
    if spec.get("z_up"):
        out["to_world"] = mi.ScalarTransform4f(_Z_UP)
    elif "to_world" in spec:
        out["to_world"] = mi.ScalarTransform4f(spec["to_world"])
    if "bitmap" in spec:
        out["bitmap"] = mi.Bitmap(np.ascontiguousarray(spec["bitmap"], np.float32))
    return out
