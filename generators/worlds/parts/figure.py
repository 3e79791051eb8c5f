"""A clothed human figure of rigid limbs, posed by its joints.

A limb's own coordinates: upper joint at the origin, lower joint on the +z axis, front towards +x. World coordinates:
x the walking direction, y to the left, z up. Metres; the figure is 1.78 m tall.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.worlds.base import Part
from spike4dgs.generators.worlds.meshes import Mesh, box, ellipsoid, loft, merge, revolve, rotation
from spike4dgs.generators.worlds.surfaces import Colour, Material
from spike4dgs.generators.worlds.textures import Canvas, cloth, fractal, mix, plain

TORSO_M, UPPER_ARM_M, FOREARM_M, THIGH_M, SHIN_M = 0.50, 0.29, 0.27, 0.45, 0.45
SHOULDER_M, HIP_M = 0.19, 0.09  # of each side, from the middle
ANKLE_M = 0.09  # above the sole
SIDES = {"left": 1.0, "right": -1.0}
_LIMBS = ("upper_arm", "forearm", "thigh", "shin", "shoe")


@dataclass(frozen=True)
class Clothes:
    """Colours, linear RGB. A `helmet` colour replaces the hair; `bag` is a backpack's colour, if there is one."""

    jacket: Colour
    stripe: Colour
    trousers: Colour
    shoes: Colour
    skin: Colour = (0.56, 0.34, 0.24)
    hair: Colour = (0.06, 0.035, 0.02)
    helmet: Colour | None = None
    bag: Colour | None = None
    number: str = ""


@dataclass(frozen=True)
class Joints:
    """Positions [3] of the joints, in the middle or by side."""

    hip: np.ndarray  # between the legs' joints
    neck: np.ndarray
    hands: Mapping[str, np.ndarray]  # wrists, by side
    ankles: Mapping[str, np.ndarray]
    toes_down: Mapping[str, float]  # radians by which each foot points down
    head_down: float = 0.0  # radians


def groups(clothes: Clothes, rng: np.random.Generator) -> dict[str, tuple[Part, ...]]:
    """Return the limbs' surfaces by name; left and right limbs look alike."""
    jacket = cloth((64, 128), rng, [clothes.jacket, clothes.jacket, clothes.jacket, clothes.stripe], 8)
    sleeve = cloth((64, 64), rng, [clothes.jacket, clothes.jacket, clothes.jacket, clothes.stripe], 16)
    denim = mix(fractal((96, 96), rng, 12, 1), *(tuple(c * f for c in clothes.trousers) for f in (0.7, 1.25)))
    denim[:, 45:50] *= 0.6  # a seam
    skin = Material(clothes.skin)
    hand = ellipsoid((0.038, 0.03, 0.065), (0, 0, FOREARM_M + 0.05), 14)
    return {
        "torso": _torso(clothes, jacket),
        "head": _head(clothes),
        "upper_arm": (Part(limb(UPPER_ARM_M, 0.058, 0.047), Material(sleeve)),),
        "forearm": (Part(limb(FOREARM_M, 0.047, 0.036), Material(sleeve)), Part(hand, skin)),
        "thigh": (Part(limb(THIGH_M, 0.088, 0.063), Material(denim)),),
        "shin": (Part(limb(SHIN_M, 0.062, 0.045), Material(denim)),),
        "shoe": _shoe(clothes),
    }


def instances(prefix: str = "") -> dict[str, str]:
    """Return instance name -> group name, both with the prefix."""
    pairs = {"torso": "torso", "head": "head"}
    pairs |= {f"{side}_{part}": part for side in SIDES for part in _LIMBS}
    return {prefix + k: prefix + v for k, v in pairs.items()}


def poses(joints: Joints, prefix: str = "") -> dict[str, np.ndarray]:
    """Return the pose [4, 4] of every limb. Knees bend forward, elbows backward and outward."""
    forward, left = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    up = joints.neck - joints.hip
    chest = np.cross(left, up / np.linalg.norm(up))
    found = {"torso": frame(joints.hip, joints.neck, chest)}
    tilt = rotation("y", joints.head_down)[:3, :3]
    found["head"] = frame(joints.neck, joints.neck + tilt @ np.array([0, 0, 1.0]), tilt @ forward)
    for side, sign in SIDES.items():
        shoulder = joints.neck - 0.06 * up / np.linalg.norm(up) + sign * SHOULDER_M * left
        hip = joints.hip + sign * HIP_M * left
        bend = -0.6 * forward - np.array([0, 0, 0.8]) + 0.5 * sign * left
        elbow, wrist = reach(shoulder, joints.hands[side], UPPER_ARM_M, FOREARM_M, bend)
        knee, ankle = reach(hip, joints.ankles[side], THIGH_M, SHIN_M, forward + 0.08 * sign * left)
        found[f"{side}_upper_arm"] = frame(shoulder, elbow, forward)
        found[f"{side}_forearm"] = frame(elbow, wrist, forward)
        found[f"{side}_thigh"] = frame(hip, knee, forward)
        found[f"{side}_shin"] = frame(knee, ankle, forward)
        foot = np.eye(4)
        foot[:3, :3], foot[:3, 3] = rotation("y", joints.toes_down[side])[:3, :3], ankle
        found[f"{side}_shoe"] = foot
    return {prefix + k: v for k, v in found.items()}


def reach(
    start: np.ndarray, goal: np.ndarray, upper_m: float, lower_m: float, bend: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return middle joint and end of a two-bone limb from `start` to `goal`, bent towards `bend` or straight."""
    way = goal - start
    distance = np.clip(np.linalg.norm(way), abs(upper_m - lower_m) + 1e-6, (upper_m + lower_m) * 0.9999)
    way = way / np.linalg.norm(way)
    along = (upper_m**2 - lower_m**2 + distance**2) / (2 * distance)
    side = bend - way * (bend @ way)
    side /= np.linalg.norm(side)
    return start + along * way + np.sqrt(max(upper_m**2 - along**2, 0.0)) * side, start + distance * way


def frame(origin: np.ndarray, towards: np.ndarray, front: np.ndarray) -> np.ndarray:
    """Return the pose [4, 4] of a limb: z from `origin` to `towards`, x as near to `front` as possible."""
    z = (towards - origin) / np.linalg.norm(towards - origin)
    x = front - z * (front @ z)
    if np.linalg.norm(x) < 1e-3:
        x = np.cross([0, 1.0, 0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.stack([x, np.cross(z, x), z, origin], 1)
    return pose


def limb(length: float, start_radius: float, end_radius: float) -> Mesh:
    """Return a rounded, tapering limb from 0 to `length` on the z axis; u runs around it."""
    a = np.linspace(0, np.pi / 2, 6)
    low = np.stack([start_radius * np.sin(a), -start_radius * np.cos(a)], 1)
    high = np.stack([end_radius * np.cos(a), length + end_radius * np.sin(a)], 1)
    return revolve(np.concatenate([low, high]), 20)


# ---------------------------------------------------------------- shapes


def _torso(clothes: Clothes, jacket: np.ndarray) -> tuple[Part, ...]:
    """Return hips, waist, chest and shoulders as one skin, and the clothes on them. z from the hip to the neck."""
    profile = np.array(  # z, half depth (x), half width (y)
        [(-0.10, 0.02, 0.05), (-0.08, 0.085, 0.125), (-0.02, 0.11, 0.155), (0.06, 0.10, 0.14), (0.14, 0.10, 0.14)]
        + [(0.27, 0.12, 0.165), (0.38, 0.125, 0.185), (0.44, 0.10, 0.185), (0.48, 0.07, 0.13), (0.51, 0.05, 0.06)]
    )
    a = np.linspace(0, 2 * np.pi, 28, endpoint=False)
    rings = np.stack([np.stack([d * np.cos(a), w * np.sin(a), 0 * a + z], 1) for z, d, w in profile])
    image = np.repeat(jacket, 2, 0)
    c = Canvas(image, 128)
    c.rectangle(0.0, 0.0, 1.0, 0.28, tuple(0.5 * v for v in clothes.trousers))  # the belt line and below
    if clothes.number:
        for x in (0.5, 0.0, 1.0):
            c.ellipse(x, 0.66, 0.10, 0.20, (0.82, 0.82, 0.80))
            c.text(clothes.number, x, 0.66, 0.20, (0.02, 0.02, 0.02), 90)
    skin = loft(rings)
    parts = [Part(skin, Material(c.image))]
    if clothes.bag is not None:
        pack = [
            ellipsoid((0.10, 0.155, 0.20), (-0.19, 0, 0.26), 20),
            ellipsoid((0.06, 0.11, 0.09), (-0.27, 0, 0.18), 16),
        ]
        straps = [box((0.26, 0.035, 0.30), (0.0, s * 0.12, 0.31)) for s in (-1, 1)]
        parts += [
            Part(merge(pack), Material(clothes.bag)),
            Part(merge(straps), Material(tuple(0.4 * v for v in clothes.bag))),
        ]
    return tuple(parts)


def _head(clothes: Clothes) -> tuple[Part, ...]:
    """Return neck, face, and hair or helmet. z up from the neck, face towards +x."""
    neck = limb(0.10, 0.055, 0.052)
    skull = ellipsoid((0.098, 0.078, 0.122), (0.02, 0, 0.19), 24)
    nose = ellipsoid((0.022, 0.014, 0.024), (0.118, 0, 0.18), 10)
    ears = [ellipsoid((0.02, 0.012, 0.03), (0.01, s * 0.08, 0.185), 8) for s in (-1, 1)]
    eyes = [ellipsoid((0.012, 0.014, 0.010), (0.104, s * 0.032, 0.212), 8) for s in (-1, 1)]
    mouth = ellipsoid((0.010, 0.026, 0.007), (0.105, 0, 0.132), 8)
    parts = [Part(merge([neck, skull, nose, *ears]), Material(clothes.skin))]
    if clothes.helmet is None:
        hair = [
            ellipsoid((0.105, 0.088, 0.095), (-0.005, 0, 0.235), 20),
            ellipsoid((0.05, 0.08, 0.10), (-0.06, 0, 0.17), 16),
        ]
        parts += [Part(merge(hair), Material(clothes.hair)), Part(merge([*eyes, mouth]), Material((0.05, 0.02, 0.02)))]
    else:
        shell = [
            ellipsoid((0.135, 0.108, 0.115), (-0.005, 0, 0.235), 24),
            ellipsoid((0.07, 0.09, 0.06), (-0.06, 0, 0.20), 16),
        ]
        ridge = [ellipsoid((0.11, 0.014, 0.10), (-0.01, s * 0.05, 0.262), 16) for s in (-1, 0, 1)]
        glasses = ellipsoid((0.03, 0.074, 0.026), (0.092, 0, 0.207), 16)
        parts += [
            Part(merge(shell), Material(clothes.helmet, 0.15)),
            Part(merge(ridge), Material(clothes.stripe, 0.15)),
            Part(merge([glasses, mouth]), Material((0.02, 0.02, 0.025), 0.1)),
        ]
    return tuple(parts)


def _shoe(clothes: Clothes) -> tuple[Part, ...]:
    """Return a shoe about the ankle, toes towards +x."""
    upper = [
        ellipsoid((0.13, 0.045, 0.045), (0.055, 0, -0.045), 18),
        ellipsoid((0.06, 0.045, 0.06), (-0.02, 0, -0.03), 14),
    ]
    sole = ellipsoid((0.145, 0.05, 0.016), (0.05, 0, -ANKLE_M + 0.016), 18)
    return (Part(merge(upper), Material(clothes.shoes)), Part(sole, Material(plain((4, 4), (0.75, 0.75, 0.72)))))
