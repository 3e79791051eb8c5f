"""Sizes and sampling of scenes, the settings of one scene, and the rig that films it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

from spike4dgs.benchmark.screen.shown import Table
from spike4dgs.benchmark.untrusted import shown
from spike4dgs.benchmark.variants import DEVELOPMENT_VARIANTS, PUBLIC_VARIANT, PUBLIC_VARIANTS
from spike4dgs.generators.physics import IDEAL, REALISTIC, Physics, from_settings
from spike4dgs.generators.sensor.light import Flicker

RATE_HZ = 20_000
TARGET_EVERY = RATE_HZ // 1000  # ticks between ground-truth frames: 1 ms


@dataclass(frozen=True)
class SplitSampling:
    """How direct and soft light are found: see `rendering.split_render`. Paths per pixel are powers of two.

    Attributes:
        paths: of the matte lobe for each surface point of a map, by all views that see it.
        gloss_paths: of a coat's gloss, which reflects a few percent, in each pixel of a map.
        sigma_px: of the Gaussian weights with which a map is smoothed over each surface.
        anchor_px: motion of the fastest point between two maps.
        spread: standard deviation of single samples of direct light for which a pixel has one; their number goes with
            its power 0.85.
    """

    paths: int
    gloss_paths: int
    sigma_px: float
    anchor_px: float
    spread: float


@dataclass(frozen=True)
class Profile:
    """Size and sampling of a scene. Samples per pixel are powers of two.

    Without `soft`, every sample is a whole path. With it one is direct light; `spp` and `target_spp` are the most of a
    pixel, whose number is chosen.
    """

    views: tuple[int, ...]  # of the 3x3 array; 4, the centre, is held out
    width: int
    height: int
    seconds: float
    spp: int  # of key frames, in the pixels that change
    background_spp: int
    target_spp: int  # of ground truth, in the pixels that change
    max_key_px: float  # largest motion of an image point between two of its keys
    sparse_every: int  # ticks between the ground-truth frames of the cameras that are not held out
    soft: SplitSampling | None = None  # of key frames
    target_soft: SplitSampling | None = None  # of ground truth

    @staticmethod
    def from_settings(sampling: Mapping[str, Any]) -> Profile:
        """Return the profile of `sampling` in `Job.settings`."""
        soft = {name: SplitSampling(**sampling[name]) for name in ("soft", "target_soft") if name in sampling}
        return Profile(**{**sampling, **soft, "views": tuple(sampling["views"])})


_ALL = tuple(range(9))

PROFILES: dict[str, Profile] = Table(
    "profiles",
    {
        "tiny": Profile((0, 2, 4, 7), 64, 40, 0.004, 16, 256, 64, 0.5, 40),
        "small": Profile(_ALL, 200, 125, 0.02, 32, 512, 256, 0.5, 100),
        "paper": Profile(_ALL, 400, 250, 0.1, 64, 512, 256, 0.25, 400),
    },
)


@dataclass(frozen=True)
class Track:
    """The scenes of a track of release 2: these variants of every world, at a profile, by a camera of `CAMERAS`.

    Their light is split: see `SPLIT_PROFILES`. `finer`: for some worlds, by what `with_finer` divides.
    """

    profile: str
    variants: tuple[int, ...]
    camera: str
    finer: Mapping[str, float] = field(default_factory=dict)


# Spokes and pipes are thinner than a pixel: their samples find no map and trace paths, whose noise falls with the
# square root of their number; chips are all edges. As other worlds are sampled, bicycle and chips have 43.5 dB where
# objects move, and car 45.3 dB in the whole image; the goal is 46.
_FINER = {"bicycle": 2.0, "motor": 2.0, "chips": 2.5, "jaywalk": 1.4, "car": 1.4, "van": 1.4}
TRACKS = {
    "small": Track("small", PUBLIC_VARIANTS, REALISTIC, _FINER),  # the main one: 27 scenes
    "dev-small": Track("small", DEVELOPMENT_VARIANTS, REALISTIC, _FINER),  # for tuning: 18 scenes, in no score
    "ideal": Track("small", (PUBLIC_VARIANT,), IDEAL),  # the camera of release 1
    "paper": Track("paper", (PUBLIC_VARIANT,), IDEAL),  # the size of the paper's scenes
}


def with_finer(profile: Profile, by: float) -> Profile:
    """Return a split profile with less noise of direct light: the spreads that choose samples, divided by a number.

    Divided by 2, pixels have 1.9 times the samples and 4 dB less noise; by 1.4, 1.3 times and more than 1 dB.
    """
    assert profile.soft is not None
    assert profile.target_soft is not None
    return replace(
        profile,
        spp=2 * profile.spp,
        background_spp=2 * profile.background_spp,
        target_spp=2 * profile.target_spp,
        soft=replace(profile.soft, spread=profile.soft.spread / by),
        target_soft=replace(profile.target_soft, spread=profile.target_soft.spread / by),
    )


# Noise where objects move, from pairs of renderings of variant 10: docs/results/rendering.md. Streams and truth smooth
# alike and have maps at the same times, so that what smoothing changes is the same light in both. Twice the pixels a
# metre smooth over as much of the surface with twice the sigma, less a margin, and may move twice as far between maps.
SPLIT_PROFILES: dict[str, Profile] = {
    "tiny": Profile(
        (0, 2, 4, 7),
        64,
        40,
        0.004,
        32,
        32,
        128,
        0.5,
        40,
        SplitSampling(32, 8, 0.5, 4, 0.0016),
        SplitSampling(64, 16, 0.5, 4, 0.0004),
    ),
    "small": Profile(
        _ALL,
        200,
        125,
        0.02,
        128,
        128,
        512,
        0.25,
        100,
        SplitSampling(64, 16, 0.5, 4, 0.0016),
        SplitSampling(128, 32, 0.5, 4, 0.0004),
    ),
    "paper": Profile(
        _ALL,
        400,
        250,
        0.1,
        128,
        128,
        512,
        0.25,
        400,
        SplitSampling(32, 8, 0.8, 8, 0.0016),
        SplitSampling(64, 16, 0.8, 8, 0.0004),
    ),
}


@dataclass(frozen=True)
class Job:
    """Settings of one scene to make."""

    world: str
    variant: int
    seed: int
    profile_name: str
    profile: Profile
    seconds: float
    gain_map: bool = True
    dark_map: bool = True
    shot_noise: bool = True
    adaptive: bool = True  # False: every pixel that changes, at every tick
    sub_ticks: bool = True  # False: never render instants inside a tick
    whole_frames: bool = False  # True: every pixel of every coarse key
    physics: Physics = Physics()
    noise: int = 0  # another number gives the rendering other noise, and changes nothing else

    @staticmethod
    def from_settings(settings: Mapping[str, Any]) -> Job:
        """Return the job of `settings`, which a file may have.

        Raises KeyError, TypeError or ValueError where some lack or are of another kind.
        """
        same = {"gain_map", "dark_map", "shot_noise", "sub_ticks", "whole_frames", "noise"} & settings.keys()
        job = Job(
            settings["world"],
            settings["variant"],
            int(settings["seed"]),
            settings["profile"],
            Profile.from_settings(settings["sampling"]),
            settings["seconds"],
            adaptive=settings.get("adaptive_keys", True),
            physics=from_settings(settings.get("physics", {})),
            **{name: settings[name] for name in same},
        )
        _check_kinds(job)
        return job

    @property
    def id(self) -> str:
        """Id such as `car-0-small`; with a length that is not the profile's, such as `car-0-paper-500ms`.

        What is not ideal in its physics follows, such as `-lens`.
        """
        length = "" if self.seconds == self.profile.seconds else f"-{self.seconds * 1000:g}ms"
        return f"{self.world}-{self.variant}-{self.profile_name}{length}{self.physics.suffix}"

    @property
    def render_seed(self) -> int:
        """Seed of the rendering's random numbers; ground truth uses the next one."""
        return self.seed + 1000 * self.noise

    @property
    def flicker(self) -> Flicker | None:
        """The flicker of the world's light, at a phase that the seed draws; None in steady light."""
        if not (p := self.physics).flicker:
            return None
        phase = np.random.default_rng([self.seed, self.variant, *f"{self.world} flicker".encode()]).uniform()
        return Flicker(p.flicker, p.flicker_hz / RATE_HZ, float(phase), p.flicker_duty)

    def light_at(self, tick: int) -> float:
        """Return the factor of the world's light at the start of a tick: 1 in steady light."""
        return self.flicker.at(tick) if self.flicker else 1.0

    @property
    def n_ticks(self) -> int:
        """Length of the clip in ticks."""
        return round(self.seconds * RATE_HZ)

    @property
    def settings(self) -> dict[str, Any]:
        """All settings that determine the bytes of the scene, except the versions of the programs."""
        found = asdict(self.profile)
        profile = {k: list(v) if isinstance(v, tuple) else v for k, v in found.items() if v is not None}
        return {
            "kind": "mitsuba",
            "world": self.world,
            "variant": self.variant,
            "seed": self.seed if self.seed < 2**63 else str(self.seed),  # readers of JSON keep 64 bits
            "profile": self.profile_name,
            "seconds": self.seconds,
            "sampling": profile,
            "gain_map": self.gain_map,
            "dark_map": self.dark_map,
            "shot_noise": self.shot_noise,
            "adaptive_keys": self.adaptive,
            "sub_ticks": self.sub_ticks,
            "whole_frames": self.whole_frames,
            **({"physics": changed} if (changed := self.physics.settings) else {}),
            **({"noise": self.noise} if self.noise else {}),
        }

    @property
    def target_ticks(self) -> range:
        """Ticks with ground truth at the held-out camera: every millisecond strictly inside the clip."""
        return range(TARGET_EVERY, self.n_ticks - TARGET_EVERY + 1, TARGET_EVERY)

    @property
    def sparse_ticks(self) -> range:
        """Ticks among `target_ticks` at which all other cameras have ground truth too."""
        return range(self.profile.sparse_every, self.target_ticks.stop, self.profile.sparse_every)


def _check_kinds(settings: Any) -> None:
    """Raise TypeError for the first field of a dataclass whose value is not of its type, however deep."""
    for name, kind in get_type_hints(type(settings)).items():
        if not _has_kind(value := getattr(settings, name), kind):
            raise TypeError(f"{name} {shown(value)}")
        if is_dataclass(value):
            _check_kinds(value)


def _has_kind(value: Any, kind: Any) -> bool:
    """Return whether a value is of a type; integers count from 0, numbers are finite."""
    if get_origin(kind) is tuple:
        return isinstance(value, tuple) and all(_has_kind(v, get_args(kind)[0]) for v in value)
    if choices := get_args(kind):
        return any(_has_kind(value, choice) for choice in choices)
    if kind not in (int, float):
        return isinstance(value, kind)
    plain = isinstance(value, int | kind) and not isinstance(value, bool)
    return plain and (value >= 0 if kind is int else math.isfinite(value))


HELD_OUT_VIEW = 4
