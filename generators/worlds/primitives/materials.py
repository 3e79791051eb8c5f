"""Materials of surfaces, and their conversion to Mitsuba."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from spike4dgs.generators.worlds.primitives.meshes import Mesh

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """A surface's reflection.

    Attributes:
        albedo: linear RGB in 0..1, one colour or an image [H, W, 3] whose top row is v = 0.
        gloss: None for a matte surface, else the roughness of a clear coat over the albedo (0.05 polished, 0.3 satin).
        metal: rough metal instead, with the albedo as its mirror colour; needs `gloss`.
    """

    albedo: Colour | np.ndarray
    gloss: float | None = None
    metal: bool = False

    def to_mitsuba(self) -> dict[str, Any]:
        """Return a BSDF dictionary for `mitsuba.load_dict`; the current variant must be set."""
        if self.metal:
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
    image = np.ascontiguousarray(np.clip(albedo, 0.01, 0.95), np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(image), "filter_type": "bilinear", "wrap_mode": "repeat"}


def mesh_to_mitsuba(name: str, mesh: Mesh, material: Material) -> Any:
    """Return a `mitsuba.Mesh` that can be a value in a scene dictionary, also inside a shape group."""
    import mitsuba as mi

    from spike4dgs.generators.worlds.primitives.meshes import vertex_normals

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
