"""The description of a world: plain data (NumPy meshes, textures, poses), independent of the renderer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from spike4dgs.generators.worlds.meshes import Mesh
from spike4dgs.generators.worlds.surfaces import Material


class Part(NamedTuple):
    """One surface: a mesh and its material."""

    mesh: Mesh
    material: Material


@dataclass(frozen=True)
class Deforming:
    """A moving surface whose vertices move independently: wings, or many rigid bodies merged into one mesh.

    Attributes:
        part: topology, texture coordinates and material; only the number of its vertices is used, not their positions.
        vertices: time in seconds -> [N, 3] float64 world positions, always in the order of `part.mesh.vertices`.
        bodies: [M] int64, the body that each face belongs to, numbered from 0 without gaps; None for a single body.
    """

    part: Part
    vertices: Callable[[float], np.ndarray]
    bodies: np.ndarray | None = None

    @cached_property
    def corner_widths(self) -> np.ndarray:
        """The width of each vertex's body at t = 0, [N], metres: twice its largest distance from the mean corner."""
        places, owner = self.vertices(0.0), np.zeros(len(self.part.mesh.vertices), np.int64)
        if self.bodies is not None:
            owner[self.part.mesh.faces] = self.bodies[:, None]
        sums = np.stack([np.bincount(owner, axis) for axis in places.T], axis=1)
        away = np.linalg.norm(places - (sums / np.bincount(owner)[:, None])[owner], axis=1)
        widths = np.zeros(len(sums))
        np.maximum.at(widths, owner, 2 * away)
        return np.asarray(widths[owner])


@dataclass(frozen=True)
class RigSpec:
    """A 3x3 array of nearly parallel cameras.

    Attributes:
        center: position of the middle camera, world metres.
        target: the point it looks at.
        spacing_m: distance between neighbouring cameras (right, up).
        toe_in: 0 = all optical axes parallel, 1 = all meet in `target`.
        fov_x_deg: horizontal field of view, the same at every resolution.
    """

    center: tuple[float, float, float]
    target: tuple[float, float, float]
    spacing_m: tuple[float, float]
    toe_in: float
    fov_x_deg: float


@dataclass(frozen=True)
class Flash:
    """Lamps whose brightness varies together, beside the steady ones of a world.

    Attributes:
        emitters: Mitsuba emitter dictionaries, at brightness 1.
        shadow_sources: [K, 4], of these lamps; see `WorldScene`.
        brightness: time in seconds -> factor from 0 up.
    """

    emitters: Mapping[str, dict[str, Any]]
    shadow_sources: np.ndarray
    brightness: Callable[[float], float]


@dataclass(frozen=True, eq=False)
class WorldScene:
    """One concrete world: static surfaces, moving surfaces, light and cameras. Metres, Z up, X right, Y away.

    Attributes:
        duration_s: as `build` was given it.
        static: surfaces that never move.
        groups: rigid groups of surfaces in their own coordinates; an instance shows one group at a pose.
        instances: instance name -> group name. Only these and `deforming` move.
        emitters: Mitsuba emitter dictionaries (numbers, lists and numpy arrays only).
        poses: time in seconds -> {instance name: [4, 4] float64 local-to-world}.
        exposure: factor from rendered radiance to scene units, in which white paper in full light has radiance 1.
        rig: the camera array.
        shadow_sources: [K, 4] homogeneous points of the main light (w = 0: at infinity). A surface point is in the
            shadow of a moving instance if the instance crosses its line to one of them.
        depth_range: (near, far) metres that enclose everything the cameras see.
        notes: physical facts to record with the data (speed, size), name -> number with the unit in the name.
        deforming: moving surfaces that are not rigid, name -> surface.
        flash: lamps whose brightness varies; None in steady light.
    """

    duration_s: float
    static: Mapping[str, Part]
    groups: Mapping[str, tuple[Part, ...]]
    instances: Mapping[str, str]
    emitters: Mapping[str, dict[str, Any]]
    poses: Callable[[float], dict[str, np.ndarray]]
    exposure: float
    rig: RigSpec
    shadow_sources: np.ndarray
    depth_range: tuple[float, float]
    notes: Mapping[str, float]
    deforming: Mapping[str, Deforming] = field(default_factory=dict)
    flash: Flash | None = None

    @property
    def layers(self) -> tuple[WorldScene, ...]:
        """The world in the light of its steady lamps alone, and, if it has a flash, in that of its flash alone.

        Lamps that are off stay where they are: they hide what is behind them.
        """
        if (flash := self.flash) is None:
            return (self,)
        dark = [{k: _without_light(v) for k, v in lamps.items()} for lamps in (self.emitters, flash.emitters)]
        off = [{name: lamp for name, lamp in lamps.items() if lamp} for lamps in dark]
        steady = replace(self, emitters={**self.emitters, **off[1]}, flash=None)
        emitters, sources = {**flash.emitters, **off[0]}, flash.shadow_sources
        return steady, replace(self, emitters=emitters, shadow_sources=sources, flash=None)

    def at_brightness(self, t_s: float) -> WorldScene:
        """Return the world with all its lamps as bright as they are at a time, and steady."""
        if (flash := self.flash) is None:
            return self
        lamps = {name: _scaled(spec, flash.brightness(t_s)) for name, spec in flash.emitters.items()}
        sources = np.concatenate([self.shadow_sources, flash.shadow_sources])
        return replace(self, emitters={**self.emitters, **lamps}, shadow_sources=sources, flash=None)

    @property
    def mirrors(self) -> np.ndarray:
        """The planes [P, 4] of static mirrors and panes: unit normal n, and n.p of their points p."""
        shiny = [part.mesh for part in self.static.values() if part.material.mirror or part.material.glass]
        corners = [mesh.vertices[mesh.faces] for mesh in shiny]
        a, b, c = np.concatenate(corners).swapaxes(0, 1) if corners else np.zeros((3, 0, 3))
        normals = np.cross(b - a, c - a)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        planes = np.concatenate([normals, (normals * a).sum(1, keepdims=True)], axis=1)
        return np.unique(planes.round(9), axis=0)

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names of the moving objects: instances, then deforming surfaces, or the bodies of those with several."""
        names = list(self.instances)
        for name, surface in self.deforming.items():
            bodies = surface.bodies
            names += [name] if bodies is None else [f"{name}/{b}" for b in range(int(bodies.max()) + 1)]
        return tuple(names)

    def moving_points(self, t_s: float) -> np.ndarray:
        """Return the world positions of all moving vertices at `t_s`, always in the same order: [N, 3] float64."""
        poses = self.poses(t_s)
        chunks = []
        for instance, group in self.instances.items():
            local = np.concatenate([part.mesh.vertices for part in self.groups[group]])
            chunks.append(local @ poses[instance][:3, :3].T + poses[instance][:3, 3])
        chunks += [surface.vertices(t_s) for surface in self.deforming.values()]
        return np.concatenate(chunks)


def _without_light(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return the surface of an emitter; nothing where it has none."""
    return {k: v for k, v in spec.items() if k != "emitter"} if "emitter" in spec else {}


def _scaled(spec: Mapping[str, Any], factor: float) -> dict[str, Any]:
    """Return an emitter of other brightness: all its colours are radiances, or the like."""
    if spec["type"] == "rgb":
        return {**spec, "value": [factor * v for v in spec["value"]]}
    return {k: _scaled(v, factor) if isinstance(v, Mapping) else v for k, v in spec.items()}


@dataclass(frozen=True)
class World:
    """A named family of scenes: `build(seed, variant, duration_s)`; variant 0 is the public benchmark's."""

    name: str
    title: str
    build: Callable[[int, int, float], WorldScene]

    @property
    def package(self) -> str:
        """The package whose code builds it: where `build` is a functools.partial, that of the function in it."""
        function = self.build
        while isinstance(function, partial):
            function = function.func
        return function.__module__.partition(".")[0]


def build_at(world: World, seed: int, variant: int, duration_s: float, speed: float) -> WorldScene:
    """Return a world with all motion, and flashes, `speed` times as fast. Its notes stay those of its own speed."""
    built = world.build(seed, variant, duration_s * speed)
    if speed == 1:
        return built

    flash = built.flash

    def faster(surface: Deforming) -> Deforming:
        return replace(surface, vertices=lambda t_s: surface.vertices(t_s * speed))

    return replace(
        built,
        duration_s=duration_s,
        poses=lambda t_s: built.poses(t_s * speed),
        deforming={name: faster(surface) for name, surface in built.deforming.items()},
        flash=flash and replace(flash, brightness=lambda t_s: flash.brightness(t_s * speed)),
    )


def rng_for(name: str, seed: int, variant: int) -> np.random.Generator:
    """Return the random generator of a world, a function of its name, seed and variant."""
    return np.random.default_rng([seed, variant, *name.encode()])
