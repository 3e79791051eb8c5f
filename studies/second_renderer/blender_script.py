"""Renders an exported scene with Cycles: `python blender_script.py SCENE.npz`, by an interpreter that has `bpy`.

This file runs alone, in another environment than the package's. The scene says where each image goes: linear radiance
as float EXR, every pixel the mean of its area, with nothing that Cycles does for looks (clamping, filtering of gloss,
denoising, tone mapping).
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

# A coat as Mitsuba's: gloss by Fresnel's law at each facet, and a matte lobe under it. The weight of a lobe can depend
# on the direction of view alone, not on that of the light; `weights` are by its cosine, 0 to 1 in even steps.
COAT = """
shader coat(color Base = 0.5, output closure color BSDF = 0)
{{
    float weights[{count}] = {{ {table} }};
    float at = clamp(abs(dot(I, N)), 0, 1) * {last};
    int first = min(int(at), {last} - 1);
    float weight = mix(weights[first], weights[first + 1], at - first);
    vector along = normalize(cross(N, abs(N[0]) > 0.9 ? vector(0, 1, 0) : vector(1, 0, 0)));
    closure color gloss = dielectric_bsdf(N, along, color(1), color(0), {alpha}, {alpha}, {ior}, "beckmann");
    BSDF = gloss + weight * Base * diffuse(N);
}}
"""


class Scene:
    """The exported scene: `facts` from JSON, `arrays` by name."""

    def __init__(self, path: Path) -> None:
        with np.load(path) as file:
            self.arrays = {name: file[name] for name in file.files}
        self.facts: dict[str, Any] = json.loads(str(self.arrays.pop("facts")))


def main() -> None:
    """Render all shots of the scene."""
    scene = Scene(Path(sys.argv[1]))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    set_quality(scene.facts)
    add_light(scene)
    images: dict[str, Any] = {}
    for surface in scene.facts["surfaces"]:
        add_surface(scene, surface, images)
    for lamp in scene.facts["lamps"]:
        add_lamp(lamp)
    for shot in scene.facts["shots"]:
        render(shot)


def set_quality(facts: dict[str, Any]) -> None:
    """Set paths of the exported length, box-filtered pixels, and nothing that changes the mean of a pixel."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = facts["width"], facts["height"]
    scene.render.resolution_percentage = 100
    scene.render.film_transparent = False
    scene.render.dither_intensity = 0
    scene.render.use_motion_blur = False
    scene.render.use_compositing = scene.render.use_sequencer = False
    scene.view_settings.view_transform = "Raw"
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGB", "32"
    cycles = scene.cycles
    cycles.device, cycles.shading_system = "CPU", any("weights" in s for s in facts["surfaces"])
    cycles.samples = facts["samples"]
    cycles.use_adaptive_sampling = cycles.use_denoising = cycles.use_fast_gi = False
    cycles.max_bounces = cycles.diffuse_bounces = cycles.glossy_bounces = facts["bounces"]
    cycles.transmission_bounces = cycles.volume_bounces = cycles.transparent_max_bounces = 0
    cycles.min_light_bounces = facts["bounces"]  # no Russian roulette
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0
    cycles.light_sampling_threshold = 0
    cycles.blur_glossy = 0
    cycles.caustics_reflective = True
    cycles.film_exposure = 1
    cycles.pixel_filter_type = "BOX"


def add_light(scene: Scene) -> None:
    """Make the sky, from a map or of one colour, and the suns."""
    world = bpy.data.worlds.new("sky")
    bpy.context.scene.world = world
    tree = world.node_tree
    tree.nodes.clear()
    background, out = tree.nodes.new("ShaderNodeBackground"), tree.nodes.new("ShaderNodeOutputWorld")
    tree.links.new(background.outputs[0], out.inputs["Surface"])
    sky = scene.facts["sky"]
    if isinstance(sky, str):
        texture = tree.nodes.new("ShaderNodeTexEnvironment")
        texture.image, texture.interpolation = new_image(sky, scene.arrays[sky]), "Linear"
        tree.links.new(texture.outputs["Color"], background.inputs["Color"])
    else:
        background.inputs["Color"].default_value = (*sky, 1)
    for number, sun in enumerate(scene.facts["suns"]):
        light = bpy.data.lights.new(f"sun{number}", "SUN")
        light.angle, light.energy = 0, 1
        light.color = sun["irradiance"]
        add_object(light, sun["matrix"])


def add_lamp(lamp: dict[str, Any]) -> None:
    """Make a rectangle that shines from its front alone."""
    mesh = bpy.data.meshes.new("lamp")
    mesh.from_pydata(lamp["corners"], [], [(0, 1, 2, 3)])
    material, tree, out = new_material("lamp")
    emission, side = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeNewGeometry")
    front = tree.nodes.new("ShaderNodeMath")
    front.operation, front.inputs[0].default_value = "SUBTRACT", 1
    emission.inputs["Color"].default_value = (*lamp["radiance"], 1)
    tree.links.new(side.outputs["Backfacing"], front.inputs[1])
    tree.links.new(front.outputs[0], emission.inputs["Strength"])
    tree.links.new(emission.outputs[0], out)
    mesh.materials.append(material)
    add_object(mesh)


def add_surface(scene: Scene, surface: dict[str, Any], images: dict[str, Any]) -> None:
    """Make a mesh with its material; textures that several use are loaded once."""
    name, arrays = surface["name"], scene.arrays
    vertices, faces, uv = (arrays[f"{name}/{key}"] for key in ("vertices", "faces", "uv"))
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices, [], faces, shade_flat=not surface["smooth"])
    mesh.uv_layers.new().uv.foreach_set("vector", uv[faces.ravel()].astype(np.float32).ravel())
    if surface["smooth"]:
        mesh.normals_split_custom_set_from_vertices(arrays[f"{name}/normals"].tolist())
    if surface["image"] not in images:
        images[surface["image"]] = new_image(surface["image"], arrays[surface["image"]])
    mesh.materials.append(dressed(surface, images[surface["image"]]))
    added = add_object(mesh)
    added.cycles.shadow_terminator_geometry_offset = added.cycles.shadow_terminator_offset = 0


def dressed(surface: dict[str, Any], image: Any) -> Any:
    """Return the material of a surface."""
    material, tree, out = new_material(surface["name"])
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.image, texture.interpolation, texture.extension = image, "Linear", "REPEAT"
    alpha = surface["gloss"]
    if alpha is None:
        node, base = tree.nodes.new("ShaderNodeBsdfDiffuse"), "Color"
        node.inputs["Roughness"].default_value = 0
    elif surface["metal"]:
        node, base = tree.nodes.new("ShaderNodeBsdfAnisotropic"), "Color"
        node.distribution = "BECKMANN"
        node.inputs["Roughness"].default_value = alpha**0.5  # Cycles squares it
    elif "weights" in surface:
        node, base = tree.nodes.new("ShaderNodeScript"), "Base"
        node.inputs.new("NodeSocketColor", "Base")  # the wheel lacks the module that finds them in the source
        node.outputs.new("NodeSocketShader", "BSDF")
        node.mode, node.filepath = "EXTERNAL", coat_source(surface)
    else:
        node, base = tree.nodes.new("ShaderNodeBsdfPrincipled"), "Base Color"
        node.distribution = "GGX"
        node.inputs["Roughness"].default_value, node.inputs["IOR"].default_value = alpha**0.5, surface["ior"]
    tree.links.new(texture.outputs["Color"], node.inputs[base])
    tree.links.new(node.outputs[0], out)
    return material


def coat_source(surface: dict[str, Any]) -> str:
    """Return the file of the OSL source of a coat, next to the scene."""
    weights = surface["weights"]
    table = ", ".join(f"{share:.9g}" for share in weights)
    path = Path(sys.argv[1]).with_name(f"coat_{surface['gloss']:g}.osl".replace(".", "_", 1))
    numbers = {"alpha": surface["gloss"], "ior": surface["ior"], "count": len(weights), "last": len(weights) - 1}
    path.write_text(COAT.format(table=table, **numbers))
    return str(path)


def new_material(name: str) -> tuple[Any, Any, Any]:
    """Return a material, its empty node tree and the input of its surface."""
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True  # Blender before 5
    tree = material.node_tree
    tree.nodes.clear()
    return material, tree, tree.nodes.new("ShaderNodeOutputMaterial").inputs["Surface"]


def new_image(name: str, pixels: np.ndarray) -> Any:
    """Return an image of linear RGB [H, W, 3], top row first, in full precision."""
    height, width = pixels.shape[:2]
    image = bpy.data.images.new(name, width, height, alpha=False, float_buffer=True, is_data=True)
    image.use_half_precision = False
    rgba = np.concatenate([pixels[::-1], np.ones((height, width, 1))], 2)  # Blender's bottom row is first
    image.pixels.foreach_set(rgba.astype(np.float32).ravel())
    image.update()
    return image


def add_object(data: Any, matrix: Any = None) -> Any:
    """Add a mesh, light or camera to the scene at a pose [4, 4]."""
    added = bpy.data.objects.new(data.name, data)
    bpy.context.scene.collection.objects.link(added)
    if matrix is not None:
        added.matrix_world = Matrix(matrix)
    return added


def render(shot: dict[str, Any]) -> None:
    """Render one view with one seed."""
    scene = bpy.context.scene
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.angle_x = "HORIZONTAL", shot["fov_x_rad"]
    data.shift_x, data.shift_y = shot["shift"]
    data.clip_start, data.clip_end = 0.01, 1e4
    scene.camera = add_object(data, shot["matrix"])
    scene.cycles.seed = shot["seed"]
    scene.render.filepath = shot["out"]
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main()
