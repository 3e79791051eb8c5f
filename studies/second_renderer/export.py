"""A world at one time as plain arrays, for a renderer in another process: surfaces, light, cameras.

The arrays come from the world alone, not from Mitsuba's scene: what that conversion gets wrong is not repeated here.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.scene.cameras import Camera, to_nerfstudio
from spike4dgs.generators.rendering.render import MAX_DEPTH
from spike4dgs.generators.worlds import WorldScene
from spike4dgs.generators.worlds.meshes import Mesh, vertex_normals
from spike4dgs.generators.worlds.surfaces import Material, reflectance
from spike4dgs.studies.second_renderer.coat import IOR, coat

SkyMap = Literal["as ours", "by texel centres"]
Coats = Literal["layered", "principled"]
_FINER = 8  # texels of the exported sky for one of ours, each way


@dataclass(frozen=True)
class Shot:
    """One rendering: a camera, a seed, and the EXR that it becomes."""

    camera: Camera
    seed: int
    out: Path


class Surface(NamedTuple):
    """One surface in the world; normals [N, 3] are those of its vertices, None where faces are flat."""

    name: str
    mesh: Mesh
    material: Material
    normals: Float64 | None


def write_scene(
    path: Path,
    world: WorldScene,
    t_s: float,
    shots: Sequence[Shot],
    samples: int,
    sky: SkyMap = "as ours",
    coats: Coats = "layered",
) -> None:
    """Write the file that `blender_script.py` renders.

    Args:
        path: the .npz to write.
        world: the world.
        t_s: the time, seconds.
        shots: cameras of one resolution, and seeds.
        samples: paths per pixel.
        sky: where a texel of the sky is: where Mitsuba has it, or at its middle.
        coats: as near to Mitsuba's as the shaders of Cycles come, or its own material.
    """
    arrays: dict[str, np.ndarray] = {}
    images: dict[int, str] = {}
    surfaces = []
    for name, mesh, material, normals in surfaces_at(world, t_s):
        arrays |= {
            f"{name}/vertices": mesh.vertices,
            f"{name}/faces": mesh.faces,
            f"{name}/uv": mesh.uv * (1, -1) + (0, 1),
        }
        if normals is not None:
            arrays[f"{name}/normals"] = normals
        image = images.setdefault(id(material.albedo), f"image{len(images)}")
        arrays[image] = reflectance(np.asarray(material.albedo).reshape(*np.shape(material.albedo)[:-1] or (1, 1), 3))
        facts = {"name": name, "smooth": mesh.smooth, "image": image, "gloss": material.gloss, "metal": material.metal}
        surfaces.append(facts | _coat_facts(material, coats))
    lights, maps = light_facts(world.emitters, sky)
    facts = {
        "width": shots[0].camera.width,
        "height": shots[0].camera.height,
        "samples": samples,
        "bounces": MAX_DEPTH - 2,  # after the first surface; the last one is lit too
        "surfaces": surfaces,
        **lights,
        "shots": [{**camera_facts(s.camera), "seed": s.seed, "out": str(s.out)} for s in shots],
    }
    with atomic_path(path) as part:
        contents: dict[str, Any] = {"facts": np.array(json.dumps(facts)), **arrays, **maps}
        np.savez(part, **contents)


def surfaces_at(world: WorldScene, t_s: float) -> Iterator[Surface]:
    """Yield the static surfaces, those of the rigid instances and the deforming ones, at a time."""
    for name, (mesh, material) in world.static.items():
        yield Surface(f"static {name}", mesh, material, vertex_normals(mesh) if mesh.smooth else None)
    poses = world.poses(t_s)
    for name, group in world.instances.items():
        for number, (mesh, material) in enumerate(world.groups[group]):
            normals = vertex_normals(mesh) @ poses[name][:3, :3].T if mesh.smooth else None
            yield Surface(f"{name} {number}", mesh.moved(poses[name]), material, normals)
    for name, deforming in world.deforming.items():
        rest, material = deforming.part
        mesh = Mesh(deforming.vertices(t_s), rest.faces, rest.uv, rest.smooth)
        yield Surface(name, mesh, material, angle_normals(mesh) if mesh.smooth else None)


def angle_normals(mesh: Mesh) -> Float64:
    """Return vertex normals [N, 3] as Mitsuba computes them: of the faces, weighted by their angles at the vertex."""
    corners = mesh.vertices[mesh.faces]
    total = np.zeros_like(mesh.vertices)
    for k in range(3):
        a, b = (corners[:, (k + j) % 3] - corners[:, k] for j in (1, 2))
        face = np.cross(a, b)
        length = np.linalg.norm(face, axis=1, keepdims=True)
        angle = np.arctan2(length, (a * b).sum(1, keepdims=True))
        np.add.at(total, mesh.faces[:, k], angle * face / np.maximum(length, 1e-30))
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30))


def camera_facts(camera: Camera) -> dict[str, Any]:
    """Return Blender's pose, field of view and shift of a camera.

    The shift is in widths of the image, to the right and up: the middle of the image is that far from the axis. Raises
    UserError for what its camera cannot be.
    """
    if camera.distortion or abs(camera.fx - camera.fy) > 1e-9 * camera.fx:
        raise problem(f"camera {camera.id}", "a pinhole with square pixels", "another camera", "use the ideal camera")
    return {
        "matrix": to_nerfstudio(camera)["transform_matrix"],
        "fov_x_rad": float(2 * np.arctan(0.5 * camera.width / camera.fx)),
        "shift": [0.5 - camera.cx / camera.width, (camera.cy - 0.5 * camera.height) / camera.width],
    }


def light_facts(emitters: Mapping[str, Mapping[str, Any]], sky: SkyMap) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the sky (a colour, or the name of a map), suns and lamps of Mitsuba's emitters, and the maps by name."""
    facts: dict[str, Any] = {"sky": [0.0, 0.0, 0.0], "suns": [], "lamps": []}
    maps = {}
    for name, spec in emitters.items():
        if spec["type"] == "envmap":
            bitmap = np.asarray(spec["bitmap"], np.float32) * np.float32(spec["scale"])
            facts["sky"], maps["sky"] = "sky", sky_map(bitmap, sky)
        elif spec["type"] == "constant":
            facts["sky"] = spec["radiance"]["value"]
        elif spec["type"] == "directional":
            facts["suns"].append({"matrix": _towards(spec["direction"]), "irradiance": spec["irradiance"]["value"]})
        elif spec["type"] == "rectangle":
            square = np.array([(-1, -1, 0, 1), (1, -1, 0, 1), (1, 1, 0, 1), (-1, 1, 0, 1)], np.float64)
            corners = (square @ np.asarray(spec["to_world"]).T)[:, :3]
            facts["lamps"].append({"corners": corners.tolist(), "radiance": spec["emitter"]["radiance"]["value"]})
        else:
            raise problem(f"light {name}", "a sky, a sun or a lamp", str(spec["type"]), "teach `light_facts` its kind")
    return facts, maps


def sky_map(bitmap: Float32, sky: SkyMap) -> Float32:
    """Return a sky as Blender's map: +x in the middle, +y a quarter to the left, zenith above the first row."""
    height, width = (size * _FINER for size in bitmap.shape[:2])
    around = 2 * np.pi * (0.5 - (np.arange(width) + 0.5) / width)  # from +x towards +y
    down = np.pi * (np.arange(height) + 0.5) / height
    x, y = np.sin(down)[:, None] * np.cos(around), np.sin(down)[:, None] * np.sin(around)
    z = np.broadcast_to(np.cos(down)[:, None], x.shape)
    return sky_radiance(bitmap, np.stack([x, y, z], -1), sky)


def sky_radiance(bitmap: Float32, directions: Float64, sky: SkyMap = "as ours") -> Float32:
    """Return the radiance [..., 3] of a sky from unit directions [..., 3], z up, linear between texels.

    Mitsuba's columns are at the middles of their texels, its first and last rows at zenith and nadir.
    """
    height, width = bitmap.shape[:2]
    x, y, z = np.moveaxis(directions, -1, 0)
    column = np.arctan2(x, y) / (2 * np.pi) % 1 * width - 0.5
    share = np.arccos(np.clip(z, -1, 1)) / np.pi
    row = np.clip(share * height - 0.5, 0, height - 1) if sky == "by texel centres" else share * (height - 1)
    left, top = np.floor(column).astype(int), np.minimum(np.floor(row).astype(int), height - 2)
    u, v = (column - left)[..., None], (row - top)[..., None]
    (a, b), (c, d) = ([bitmap[r, k % width] for k in (left, left + 1)] for r in (top, top + 1))
    return np.asarray((a * (1 - u) + b * u) * (1 - v) + (c * (1 - u) + d * u) * v, np.float32)


def _towards(direction: Sequence[float]) -> list[list[float]]:
    """Return a pose [4, 4] whose -z axis is a direction, as Blender's lamps shine."""
    z = -np.asarray(direction, np.float64)
    z /= np.linalg.norm(z)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], 1)
    return pose.tolist()


@lru_cache
def _weights(gloss: float) -> list[float]:
    return coat(gloss).weights.tolist()  # type: ignore[no-any-return]


def _coat_facts(material: Material, coats: Coats) -> dict[str, Any]:
    if material.gloss is None or material.metal:
        return {}
    return {"ior": IOR} if coats == "principled" else {"ior": IOR, "weights": _weights(material.gloss)}
