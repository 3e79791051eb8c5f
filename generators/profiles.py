"""How large a scene is and how carefully it is rendered: one table, and what one scene is asked for."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

RATE_HZ = 20_000
TARGET_EVERY = RATE_HZ // 1000  # ticks between ground-truth frames: 1 ms


@dataclass(frozen=True)
class Profile:
    """Size and sampling of a scene. Samples per pixel are powers of two."""

    views: tuple[int, ...]  # of the 3x3 array; 4, the centre, is held out
    width: int
    height: int
    seconds: float
    spp: int  # of key frames, inside the region that changes
    background_spp: int
    target_spp: int  # of ground truth
    target_background_spp: int
    max_key_px: float  # that the fastest image point moves between two keys


_ALL = tuple(range(9))

PROFILES: dict[str, Profile] = {
    "tiny": Profile((0, 2, 4, 7), 64, 40, 0.004, 16, 64, 64, 256, 0.5),
    "small": Profile(_ALL, 200, 125, 0.02, 32, 256, 256, 1024, 0.5),
    "paper": Profile(_ALL, 400, 250, 0.1, 64, 512, 256, 1024, 0.5),
}


@dataclass(frozen=True)
class Job:
    """One scene to make."""

    world: str
    variant: int
    seed: int
    profile_name: str
    profile: Profile
    seconds: float
    gain_map: bool = True
    dark_map: bool = True

    @property
    def id(self) -> str:
        """Such as `car-0-small`; a length that is not the profile's is added: `car-0-paper-500ms`."""
        usual = self.seconds == self.profile.seconds
        return f"{self.world}-{self.variant}-{self.profile_name}" + ("" if usual else f"-{self.seconds * 1000:g}ms")

    @property
    def n_ticks(self) -> int:
        """Length of the clip in ticks."""
        return round(self.seconds * RATE_HZ)

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that decides about the bytes of the scene, except the versions of the programs."""
        profile = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self.profile).items()}
        return {
            "kind": "mitsuba",
            "world": self.world,
            "variant": self.variant,
            "seed": self.seed,
            "profile": self.profile_name,
            "seconds": self.seconds,
            "sampling": profile,
            "gain_map": self.gain_map,
            "dark_map": self.dark_map,
        }

    @property
    def target_ticks(self) -> range:
        """Ticks with ground truth: every millisecond strictly inside the clip."""
        return range(TARGET_EVERY, self.n_ticks - TARGET_EVERY + 1, TARGET_EVERY)
