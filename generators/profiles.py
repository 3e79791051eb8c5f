"""How large a scene is and how carefully it is rendered: one table."""

from __future__ import annotations

from dataclasses import dataclass

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
