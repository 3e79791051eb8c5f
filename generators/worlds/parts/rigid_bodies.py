"""Rigid bodies that fall, collide and slide: MuJoCo at the sensor's rate, one step per tick."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.worlds.meshes import Mesh

STEP_S = 5e-5
GRAVITY_M_S2 = 9.81
SOFT_M = 1e-3  # depth by which contacts may give way


@dataclass(frozen=True)
class Body:
    """One body and its initial state.

    Attributes:
        shape: "box" (half sizes x, y, z), "sphere" (radius) or "cylinder" (radius, half height; axis z).
        size: of the shape, metres.
        position: of its centre.
        rotation: unit quaternion (w, x, y, z).
        velocity, spin: m/s and rad/s, in world coordinates.
        density: kg/m^3.
    """

    shape: str
    size: tuple[float, ...]
    position: tuple[float, float, float]
    rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    spin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    density: float = 700.0

    def flight(self, t_s: float) -> np.ndarray:
        """Return the pose [4, 4] in free flight at `t_s` (also negative) from the beginning, with constant spin."""
        angle = float(np.linalg.norm(self.spin)) * t_s
        axis = np.array(self.spin) / max(float(np.linalg.norm(self.spin)), 1e-12)
        turns = rotations(np.array([[np.cos(angle / 2), *(np.sin(angle / 2) * axis)], self.rotation]))
        pose = np.eye(4)
        pose[:3, :3] = turns[0] @ turns[1]
        pose[:3, 3] = np.array(self.position) + np.array(self.velocity) * t_s
        pose[2, 3] -= GRAVITY_M_S2 / 2 * t_s**2
        return pose


@dataclass(frozen=True)
class Block:
    """A static obstacle: an upright box from corner `low` to corner `high`, metres."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @classmethod
    def around(cls, mesh: Mesh) -> Block:
        """Return the smallest block that holds a mesh."""
        return cls(tuple(mesh.vertices.min(0).tolist()), tuple(mesh.vertices.max(0).tolist()))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Positions [T, B, 3] and unit quaternions [T, B, 4] of all bodies, every STEP_S from `start_s` on."""

    start_s: float
    positions: np.ndarray
    quaternions: np.ndarray

    def at(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return rotations [B, 3, 3] and positions [B, 3] at a time: linear between steps, clamped at both ends."""
        x = np.clip((t_s - self.start_s) / STEP_S, 0.0, len(self.positions) - 1.0)
        k = min(int(x), len(self.positions) - 2)
        f = x - k
        position = (1 - f) * self.positions[k] + f * self.positions[k + 1]
        a, b = self.quaternions[k], self.quaternions[k + 1]
        q = (1 - f) * a + f * np.where((a * b).sum(1, keepdims=True) < 0, -b, b)
        return rotations(q / np.linalg.norm(q, axis=1, keepdims=True)), position

    def vertices(self, t_s: float, local: np.ndarray, owner: np.ndarray) -> np.ndarray:
        """Return world positions [N, 3] of points `local` [N, 3] in the coordinates of the bodies `owner` [N]."""
        turn, shift = self.at(t_s)
        return np.einsum("nij,nj->ni", turn[owner], local) + shift[owner]


def rotations(q: np.ndarray) -> np.ndarray:
    """Return the rotation matrices [B, 3, 3] of unit quaternions [B, 4] (w, x, y, z)."""
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def simulate(
    bodies: Sequence[Body], start_s: float, end_s: float, friction: float = 0.5, blocks: Sequence[Block] = ()
) -> Trajectory:
    """Simulate bodies among `blocks` over a table at z = 0, under gravity. Equal arguments give equal bits.

    Raises ValueError where bodies overlap at the beginning by more than SOFT_M (MuJoCo would shoot them apart), and
    FloatingPointError where the motion is unstable (MuJoCo alone would restart silently).
    """
    import mujoco

    model = mujoco.MjModel.from_xml_string(_xml(bodies, friction, blocks))
    data = mujoco.MjData(model)
    for k, body in enumerate(bodies):
        data.qpos[7 * k : 7 * k + 7] = (*body.position, *body.rotation)
        turn = rotations(np.array([body.rotation]))[0]
        data.qvel[6 * k : 6 * k + 6] = (*body.velocity, *(turn.T @ np.array(body.spin)))  # MuJoCo: spin in body axes
    mujoco.mj_forward(model, data)
    overlap_m = -min(data.contact.dist, default=0.0)
    if overlap_m > SOFT_M:
        raise ValueError(f"bodies overlap by {1e3 * overlap_m:.2f} mm before they move")
    steps = int(np.ceil((end_s - start_s) / STEP_S - 1e-9)) + 1
    state = np.empty((steps + 1, len(bodies), 7))
    state[0] = data.qpos.reshape(-1, 7)
    for k in range(steps):
        mujoco.mj_step(model, data)
        state[k + 1] = data.qpos.reshape(-1, 7)
    if any(warning.number for warning in data.warning):
        raise FloatingPointError("the motion of the bodies became unstable")
    return Trajectory(start_s, state[..., :3].copy(), state[..., 3:].copy())


def owners(meshes: Sequence[Mesh]) -> tuple[np.ndarray, np.ndarray]:
    """Return the body of each vertex [N] and of each face [M] of the merged meshes, one mesh per body."""
    numbers = range(len(meshes))
    vertex = [np.full(len(m.vertices), k) for k, m in zip(numbers, meshes, strict=True)]
    face = [np.full(len(m.faces), k) for k, m in zip(numbers, meshes, strict=True)]
    return np.concatenate(vertex), np.concatenate(face)


def _xml(bodies: Sequence[Body], friction: float, blocks: Sequence[Block]) -> str:
    """Return MuJoCo's model. A contact is a spring with `solref` = (1 / decay rate in s, damping ratio).

    At 0.3 ms and 0.4 a body that hits at v m/s sinks in by about 0.1 v mm and leaves at a quarter of its speed.
    """
    fixed = [_fixed(np.array(block.low), np.array(block.high)) for block in blocks]
    free = [
        f'<body><freejoint/><geom type="{b.shape}" size="{_words(b.size)}" density="{b.density}"/></body>'
        for b in bodies
    ]
    return f"""<mujoco>
  <option timestep="{STEP_S}" gravity="0 0 {-GRAVITY_M_S2}" integrator="implicitfast" cone="pyramidal" iterations="50"/>
  <default><geom friction="{friction} 0.002 0.0001" solref="0.0003 0.4" solimp="0.95 0.99 0.0005"/></default>
  <worldbody><geom type="plane" size="5 5 0.1"/>{"".join(fixed + free)}</worldbody>
</mujoco>"""


def _fixed(low: np.ndarray, high: np.ndarray) -> str:
    return f'<geom type="box" pos="{_words((low + high) / 2)}" size="{_words((high - low) / 2)}"/>'


def _words(numbers: Sequence[float] | np.ndarray) -> str:
    return " ".join(repr(float(v)) for v in numbers)
