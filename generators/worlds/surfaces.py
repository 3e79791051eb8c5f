"""Materials of surfaces, and lamps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from spike4dgs.generators.worlds.meshes import Mesh, vertex_normals

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """A surface's reflection.

    Attributes:
        albedo: linear RGB in 0..1, one colour or an image [H, W, 3] whose top row is v = 0.
        gloss: None for a matte surface, else the roughness of a clear coat over the albedo (0.05 polished, 0.3 satin).
        metal: rough metal instead, with the albedo as its mirror colour; needs `gloss`. With a `gloss` of 0 it is a
            mirror; its mesh has to be static and of plane faces.
        glass: a thin clear pane instead, without an albedo; its mesh has to be static and one plane.
    """

    albedo: Colour | np.ndarray
    gloss: float | None = None
    metal: bool = False
    glass: bool = False

    @property
    def mirror(self) -> bool:
        """Whether the surface is a mirror."""
        return self.metal and self.gloss == 0

    def to_mitsuba(self) -> dict[str, Any]:
        """Return a BSDF dictionary for `mitsuba.load_dict`; the current variant must be set."""
        if self.glass:
            return {"type": "thindielectric"}  # two-sided by itself
        if self.mirror:
            inner: dict[str, Any] = {"type": "conductor", "specular_reflectance": _texture(self.albedo)}
        elif self.metal:
            inner = {"type": "roughconductor", "alpha": self.gloss, "specular_reflectance": _texture(self.albedo)}
        elif self.gloss is not None:
            inner = {"type": "roughplastic", "alpha": self.gloss, "diffuse_reflectance": _texture(self.albedo)}
        else:
            inner = {"type": "diffuse", "reflectance": _texture(self.albedo)}
        return {"type": "twosided", "bsdf": inner}


def _texture(albedo: Colour | np.ndarray) -> dict[str, Any]:
    """Return a constant colour or a repeating image, clipped to the reflectance of real surfaces."""
    import mitsuba as mi

    if not isinstance(albedo, np.ndarray):
        return {"type": "rgb", "value": [float(np.clip(c, 0.0, 0.95)) for c in albedo]}
    bitmap = mi.Bitmap(np.ascontiguousarray(reflectance(albedo)))
    return {"type": "bitmap", "bitmap": bitmap, "filter_type": "bilinear", "wrap_mode": "repeat"}


def reflectance(albedo: np.ndarray) -> np.ndarray:
    """Return an image of albedo as float32, clipped to the reflectance of real surfaces."""
    return np.clip(albedo, 0.01, 0.95).astype(np.float32)


def mesh_to_mitsuba(name: str, mesh: Mesh, material: Material) -> Any:
    """Return a `mitsuba.Mesh` that can be a value in a scene dictionary, also inside a shape group."""
    import mitsuba as mi

    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(material.to_mitsuba())
    properties["face_normals"] = not mesh.smooth
    shape = mi.Mesh(
        name,
        len(mesh.vertices),
        len(mesh.faces),
        props=properties,
        has_vertex_normals=mesh.smooth,
        has_vertex_texcoords=True,
    )
    buffers = mi.traverse(shape)
    buffers["vertex_positions"] = np.ascontiguousarray(mesh.vertices, np.float32).ravel()
    buffers["faces"] = np.ascontiguousarray(mesh.faces, np.uint32).ravel()
    buffers["vertex_texcoords"] = np.ascontiguousarray(mesh.uv, np.float32).ravel()
    if mesh.smooth:
        buffers["vertex_normals"] = np.ascontiguousarray(vertex_normals(mesh), np.float32).ravel()
    buffers.update()
    return shape


_HALF_M = 0.16


@dataclass(frozen=True)
class Lamp:
    """A hanging lamp: its position in metres, its strength, and the point that it shines on."""

    position: tuple[float, float, float] = (-0.85, -0.75, 1.7)
    power: float = 1.0
    target: tuple[float, float, float] = (0.0, 0.0, 0.1)

    @property
    def frame(self) -> np.ndarray:
        """Pose [4, 4] of the square: its z axis points at the target."""
        origin = np.array(self.position)
        forward = np.array(self.target) - origin
        forward /= np.linalg.norm(forward)
        left = np.cross([0.0, 0.0, 1.0], forward)
        left /= np.linalg.norm(left)
        pose = np.eye(4)
        pose[:3] = np.stack([left, np.cross(forward, left), forward, origin], 1)
        return pose

    @property
    def points(self) -> np.ndarray:
        """Homogeneous points [5, 4]: the middle and the corners of the lamp."""
        corners = np.array([(0, 0, 0, 1)] + [(a, b, 0, 1) for a in (-1, 1) for b in (-1, 1)], np.float64)
        corners[:, :2] *= _HALF_M
        return np.asarray(corners @ self.frame.T)

    def emitters(self, room: float = 1.0) -> dict[str, dict[str, Any]]:
        """Return Mitsuba emitters: the lamp, sampled, and weak room light, found by BSDF sampling only."""
        power = 62.0 * self.power
        scale = np.diag([_HALF_M, _HALF_M, 1.0, 1.0])
        return {
            "lamp": {
                "type": "rectangle",
                "to_world": self.frame @ scale,
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [power, power * 0.95, power * 0.88]}},
            },
            "room": {
                "type": "constant",
                "radiance": {"type": "rgb", "value": [0.40 * room, 0.43 * room, 0.48 * room]},
                "sampling_weight": 0.0,
            },
        }
