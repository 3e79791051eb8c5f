"""The public folder of a season, below leaderboard/seasons:

N/season.json           the commitments, the rules, the dates: written once, before anything is submitted
N/results/METHOD.json   the scores of each submission
N/table.md              the same as a table
N/opening.json          the secret seeds, once the season is over
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from spike4dgs.benchmark.environment import harness
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_json, write_json, write_text
from spike4dgs.benchmark.json_values.text import json_text
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.benchmark.variants import FIRST_SEASON_VARIANT

OPENING_NAME, OPENING_SCHEMA = "opening.json", "spike4dgs-season-opening/1"
SALT_BITS, SEED_BITS = 256, 128
Rendering = Literal["paths", "split"]  # of `make-dataset`
_FIX = "restore the file that `season make` wrote"


@dataclass(frozen=True)
class Seed:
    """What `make-dataset` needs to make a hidden scene; the seed as decimal digits."""

    world: str
    variant: int
    profile: str
    seed: str
    rendering: Rendering = "paths"

    @property
    def scene(self) -> str:
        """The scene's id, as `make-dataset` names it."""
        return f"{self.world}-{self.variant}-{self.profile}"

    @property
    def command(self) -> str:
        """The command line that makes the scene."""
        where = f"--profile {self.profile} --variant {self.variant} --rendering {self.rendering}"
        return f"spike4dgs make-dataset {self.world} {where} --seed {self.seed}"

    @property
    def facts(self) -> dict[str, Any]:
        """What opening.json holds of it; paths, the rendering of season 0, are not named."""
        return {k: v for k, v in asdict(self).items() if (k, v) != ("rendering", "paths")}


@dataclass(frozen=True)
class Opening:
    """The secret of a season. `harness` is the version and commit of the code that makes its scenes.

    The commitment is the SHA-256 of the file, so `sha256sum opening.json` checks it. A random salt of 256 bits keeps
    anyone from guessing what is in it. Seeds have 128 bits: the sensors' maps are a function of the seed alone, and
    published recordings would show a guessed one.
    """

    season: int
    salt: str  # hex digits
    harness: dict[str, Any]
    scenes: tuple[Seed, ...]

    @property
    def text(self) -> str:
        """The bytes of opening.json: equal openings have equal texts."""
        return json_text({"schema": OPENING_SCHEMA, **asdict(self), "scenes": [s.facts for s in self.scenes]})

    @property
    def sha256(self) -> str:
        """The commitment."""
        return hashlib.sha256(self.text.encode()).hexdigest()


def draw_opening(season: int, worlds: Sequence[str], profile: str, rendering: Rendering = "split") -> Opening:
    """Return an opening with a salt and seeds from the system's source of randomness.

    Every scene has variant FIRST_SEASON_VARIANT + `season`.
    """
    variant = FIRST_SEASON_VARIANT + season
    seeds = tuple(Seed(world, variant, profile, str(secrets.randbits(SEED_BITS)), rendering) for world in worlds)
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
    write_text(folder / OPENING_NAME, opening.text)
    (folder / OPENING_NAME).chmod(0o600)


SEASONS = Path("leaderboard/seasons")
SCHEMA = "spike4dgs-season/1"
NAME = "season.json"


@dataclass(frozen=True)
class HiddenScene:
    """The commitments to a hidden scene.

    `training_*` are those of its training part, which has no truth. `pack_sha256` is the SHA-256 of the scene as a tar.
    """

    id: str
    world: str
    variant: int
    profile: str
    revision: str
    pack_sha256: str
    training_revision: str
    training_pack_sha256: str


@dataclass(frozen=True)
class Season:
    """The facts of season.json."""

    season: int
    opens: str  # time in UTC
    closes: str | None  # last day of submissions; None: they end when the seeds are revealed
    streams: str  # "published", or "hidden": then methods alone can be submitted
    budget: str  # of methods that the maintainers run, as --budget takes it
    fit_seed: int  # of those
    opening_sha256: str
    harness: dict[str, Any]  # version, commit and dirty flag of the code that made the scenes
    rendered_on: dict[str, str]  # the versions that made the scenes, and the CPU
    scenes: tuple[HiddenScene, ...]

    @property
    def training_revisions(self) -> dict[str, str]:
        """The revision of each scene's training part, by scene id."""
        return {scene.id: scene.training_revision for scene in self.scenes}


def season_folder(seasons: Path, number: int) -> Path:
    """Return the public folder of a season."""
    return seasons / str(number)


def is_announced(seasons: Path, number: int) -> bool:
    """Return whether the season's commitments are written."""
    return (season_folder(seasons, number) / NAME).exists()


def is_revealed(seasons: Path, number: int) -> bool:
    """Return whether the season's seeds are public."""
    return (season_folder(seasons, number) / OPENING_NAME).exists()


def read_season(seasons: Path, number: int) -> Season:
    """Read season.json. Raises UserError where it is missing, damaged or another season's."""
    path = season_folder(seasons, number) / NAME
    data = read_json(path, "a season")
    schema = load_schema("spike4dgs.leaderboard.season", "season.schema.json")
    check_schema(data, schema, path, "restore the file from git")
    if data["season"] != number:
        raise problem(path, f"season {number}", f"season {data['season']}", "rename its folder")
    scenes = tuple(HiddenScene(**scene) for scene in data["scenes"])
    return Season(**{k: v for k, v in data.items() if k not in ("schema", "scenes")}, scenes=scenes)


def write_season(seasons: Path, season: Season) -> Path:
    """Write season.json and return its path. Raises UserError where there is one: commitments never change."""
    path = season_folder(seasons, season.season) / NAME
    if path.exists():
        raise problem(path, "no such file yet", "the commitments of a season", "choose another number")
    data = {"schema": SCHEMA, **asdict(season), "scenes": [asdict(scene) for scene in season.scenes]}
    check_schema(data, load_schema("spike4dgs.leaderboard.season", "season.schema.json"), path, "correct the arguments")
    write_json(path, data)
    return path
