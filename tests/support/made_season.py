"""A small season for tests: its public files, the maintainers' folder, and predictions of participants."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.method import Budget
from spike4dgs.benchmark.runs.run import Settings
from spike4dgs.cli.season import score
from spike4dgs.leaderboard.season.results import predict_all
from spike4dgs.leaderboard.season.season_file import Season, read_season
from spike4dgs.leaderboard.season.secret_folder import open_committed

NUMBER = 3
WORLDS = ("car", "turntable")


@dataclass(frozen=True)
class Made:
    """A season's public files, the maintainers' folder, and predictions of a participant."""

    root: Path

    @property
    def seasons(self) -> Path:
        return self.root / "seasons"

    @property
    def secret(self) -> Path:
        return self.root / "secret"

    @property
    def public(self) -> Path:
        return self.seasons / str(NUMBER)

    @property
    def season(self) -> Season:
        return read_season(self.seasons, NUMBER)

    def predict(self, *methods: Any) -> Path:
        """Fit methods on the training parts; return the folder of their predictions."""
        scenes = open_committed(self.secret, self.season, training=True)
        assert not predict_all(scenes, methods, Settings(self.root / "runs", budget=Budget(0.5)))
        return self.root / "runs/predictions"

    def score(self, *names: str) -> int:
        folders = tuple(self.root / "runs/predictions" / name for name in names)
        return score(NUMBER, secret=self.secret, seasons=self.seasons, predictions=folders)
