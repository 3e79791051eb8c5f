"""The opening of a season's commitment: the secret seeds, which are revealed at the end.

The commitment is the SHA-256 of the file opening.json, so `sha256sum opening.json` checks it. A random salt of 256 bits
keeps anyone from guessing what is in the file. Seeds have 128 bits: the sensors' maps are a function of the seed alone,
and published recordings would show a guessed one.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.environment import harness
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import json_text, read_json, write_text
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.benchmark.variants import FIRST_SEASON_VARIANT

NAME = "opening.json"
SCHEMA = "spike4dgs-season-opening/1"
SALT_BITS, SEED_BITS = 256, 128
_FIX = "restore the file that `season make` wrote"


@dataclass(frozen=True)
class Seed:
    """A hidden scene's world, variant and profile, and its seed as decimal digits, for `make-dataset`."""

    world: str
    variant: int
    profile: str
    seed: str

    @property
    def scene(self) -> str:
        """The scene's id, as `make-dataset` names it."""
        return f"{self.world}-{self.variant}-{self.profile}"

    @property
    def command(self) -> str:
        """The command line that makes the scene."""
        where = f"--profile {self.profile} --variant {self.variant}"
        return f"spike4dgs make-dataset {self.world} {where} --seed {self.seed}"


@dataclass(frozen=True)
class Opening:
    """The secret of a season. `harness` is the version and commit of the code that makes its scenes."""

    season: int
    salt: str  # hex digits
    harness: dict[str, Any]
    scenes: tuple[Seed, ...]

    @property
    def text(self) -> str:
        """The bytes of opening.json: equal openings have equal texts."""
        return json_text({"schema": SCHEMA, **asdict(self), "scenes": [asdict(s) for s in self.scenes]})

    @property
    def sha256(self) -> str:
        """The commitment."""
        return hashlib.sha256(self.text.encode()).hexdigest()


def draw_opening(season: int, worlds: Sequence[str], profile: str) -> Opening:
    """Return an opening with a salt and seeds from the system's source of randomness.

    Every scene has variant FIRST_SEASON_VARIANT + `season`.
    """
    variant = FIRST_SEASON_VARIANT + season
    seeds = tuple(Seed(world, variant, profile, str(secrets.randbits(SEED_BITS))) for world in worlds)
    return Opening(season, secrets.token_hex(SALT_BITS // 8), harness(), seeds)


def read_opening(path: Path, sha256: str | None = None) -> Opening:
    """Read opening.json. Raises UserError where it is damaged, and unless its SHA-256 is `sha256`, if that is given.

    Only the one text that `Opening.text` gives for its content is accepted: a commitment has one meaning.
    """
    data = read_json(path, "a season's opening")
    check_schema(data, load_schema("spike4dgs.leaderboard.season", "opening.schema.json"), path, _FIX)
    scenes = tuple(Seed(**scene) for scene in data["scenes"])
    opening = Opening(data["season"], data["salt"], data["harness"], scenes)
    if path.read_bytes() != opening.text.encode():
        raise problem(path, "the text that `season make` writes", "the same content in another form", _FIX)
    if sha256 is not None and opening.sha256 != sha256:
        raise problem(path, f"sha256 {sha256}, as committed", opening.sha256, _FIX)
    return opening


def write_secret(folder: Path, opening: Opening) -> None:
    """Write opening.json into a folder that only its owner can read."""
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(0o700)
    write_text(folder / NAME, opening.text)
    (folder / NAME).chmod(0o600)
