"""Light of the tabletop worlds: one square lamp, sampled, and weak light from all directions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

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
