"""The public folder of a season, below leaderboard/seasons:

N/season.json           the commitments, the rules, the dates: written once, before anything is submitted
N/results/METHOD.json   the scores of each submission
N/table.md              the same as a table
N/opening.json          the secret seeds, once the season is over
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_json, write_json
from spike4dgs.benchmark.method import Budget, make_budget
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.leaderboard.season import opening

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

    @property
    def fit_budget(self) -> Budget:
        """The budget of methods that the maintainers run."""
        return make_budget(self.budget)


def season_folder(seasons: Path, number: int) -> Path:
    """Return the public folder of a season."""
    return seasons / str(number)


def is_announced(seasons: Path, number: int) -> bool:
    """Return whether the season's commitments are written."""
    return (season_folder(seasons, number) / NAME).exists()


def is_revealed(seasons: Path, number: int) -> bool:
    """Return whether the season's seeds are public."""
    return (season_folder(seasons, number) / opening.NAME).exists()


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
