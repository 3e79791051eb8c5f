"""Score submissions to a season; its results are one file for each, and the table that is made from them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import locked, read_json, remove_parts, visible, write_json, write_text
from spike4dgs.benchmark.method import Method, choose_device_for, get_method, make_budget
from spike4dgs.benchmark.metrics.measure import AUTO, mean, select_metrics
from spike4dgs.benchmark.metrics.table import METRICS, PRIMARY
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.benchmark.runs.apart.fit import Apart
from spike4dgs.benchmark.runs.cell import Job
from spike4dgs.benchmark.runs.display import RunDisplay
from spike4dgs.benchmark.runs.record import PROTOCOL, Record, check_record, is_complete, with_later_metrics
from spike4dgs.benchmark.runs.run import JobFiles, Settings, fit_here
from spike4dgs.benchmark.runs.score import score_predictions
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.leaderboard.entry import check_no_oracle
from spike4dgs.leaderboard.season.season_file import Season, is_revealed, read_season, season_folder
from spike4dgs.leaderboard.season.secret_folder import open_committed, runs_folder


def predict_all(scenes: Sequence[Scene], methods: Sequence[Method], settings: Settings) -> set[str]:
    """Fit every method on every scene and write predictions, or keep those that are there. Nothing is scored.

    Return the names of the methods that failed on a scene; the traceback is in a log file.
    """
    failed = set()
    with (
        locked(settings.out / ".lock", settings.out, "a folder that no other run uses"),
        RunDisplay(make_console(), len(scenes) * len(methods), [m.name for m in methods for _ in scenes]) as display,
    ):
        remove_parts(settings.out)
        for method, scene in product(methods, scenes):
            job = Job(method, scene, settings.seed, settings.device, settings.budget)
            files = JobFiles(job, settings.out, apart=settings.apart)
            with display.cell(f"{method.name} on {scene.id}") as shown:
                if failure := fit_here(files, shown):
                    write_text(files.log, failure.traceback)
                    shown.note(f"{failure.status}: {failure.reason} (see {files.log})")
                    failed.add(method.name)
    return failed


SCHEMA = "spike4dgs-season-result/1"
TABLE = "table.md"
PREDICTIONS, METHOD = "predictions", "method"  # the ways to submit
_SHOWN = ("psnr", "ssim", "psnr_dynamic", "ssim_dynamic", "temporal_error")


@dataclass(frozen=True)
class Result:
    """The record of a submission, and the way in which it was submitted."""

    submitted_as: str  # PREDICTIONS or METHOD
    record: Record

    @property
    def name(self) -> str:
        """The method's name."""
        return str(self.record["method"]["name"])

    @property
    def predictions_sha256(self) -> dict[str, str | None]:
        """The SHA-256 of each scene's SHA256SUMS."""
        return {scene: cell["predictions_sha256"] for scene, cell in self.record["scenes"].items()}


def result_path(seasons: Path, number: int, method: str) -> Path:
    """Return the file of a method's result."""
    return season_folder(seasons, number) / "results" / f"{method}.json"


def write_result(seasons: Path, number: int, result: Result) -> None:
    """Write a result, or keep the one of the same predictions.

    Raises UserError where the method has other predictions there: a name is scored once, so that nobody can tune
    against hidden scenes.
    """
    path = result_path(seasons, number, result.name)
    check_no_oracle(result.record, path)
    for other in visible(path.parent, "*.json"):
        if other.stem != result.name and _alike(other.stem) == _alike(result.name):
            fix = "a name is scored once in a season, however it is written: submit under another one"
            raise problem(path, "a name that differs in letters or digits", other.stem, fix)
    if path.exists():
        if read_result(path).predictions_sha256 != result.predictions_sha256:
            fix = "a name is scored once in a season: submit under another one"
            raise problem(path, "no result of this name, or the same predictions", "other predictions", fix)
        return
    write_json(path, {"schema": SCHEMA, "submitted_as": result.submitted_as, "record": result.record})


def _alike(name: str) -> str:
    """Return the letters and digits of a name, and the + and brackets that tell recipes apart."""
    return "".join(c for c in name.casefold() if c.isalnum() or c in "+[]=")


def read_result(path: Path) -> Result:
    """Read a result. Raises UserError where it is damaged or inconsistent, or where its file has another name."""
    data = read_json(path, "a season's result")
    schema = load_schema("spike4dgs.leaderboard.season", "season_result.schema.json")
    check_schema(data, schema, path, "score the submission again")
    result = Result(data["submitted_as"], with_later_metrics(data["record"]))
    check_record(result.record, path)
    check_no_oracle(result.record, path)
    if result.name != path.stem:
        raise problem(path, f"the result of {path.stem}", result.name, "rename the file")
    return result


def read_results(seasons: Path, season: Season) -> list[Result]:
    """Return the results of a season, best first; incomplete ones follow.

    Raises UserError where one is damaged, or is of other scenes than the season's.
    """
    found = []
    expected = {scene.id: scene.revision for scene in season.scenes}
    for path in visible(season_folder(seasons, season.season) / "results", "*.json"):
        result = read_result(path)
        if (scenes := result.record["dataset"]["scenes"]) != expected:
            raise problem(path, f"scores of the committed {json.dumps(expected)}", json.dumps(scenes), "score it again")
        found.append(result)
    return sorted(found, key=_order)


def _order(result: Result) -> tuple[bool, float, str]:
    value = result.record["mean"][PRIMARY] if is_complete(result.record) else None
    sign = -1.0 if METRICS[PRIMARY].higher_is_better else 1.0
    return value is None, sign * (value or 0.0), result.name


def table_text(season: Season, results: Sequence[Result]) -> str:
    """Return the table of a season: the mean over its scenes, best first. Equal results give equal texts."""
    scenes, few = ", ".join(f"`{scene.id}`" for scene in season.scenes), len(season.scenes)
    header = ["order", "method", "submitted as", *(METRICS[m].title for m in _SHOWN), "fit, s"]
    about = f"Means over {scenes}; {PROTOCOL['name']}, version {PROTOCOL['version']}."
    note = f"{few} scenes do not tell near rows apart." if few > 1 else "One scene does not tell near rows apart."
    lines = [f"# Season {season.season}", "", about, note, "", f"| {' | '.join(header)} |", "|" + "---|" * len(header)]
    for position, result in enumerate(results, start=1):
        order = str(position) if is_complete(result.record) else "-"
        seconds = mean(cell["fit_seconds"] for cell in result.record["scenes"].values())
        fit = "-" if seconds is None else f"{seconds:.0f}"
        values = [METRICS[m].format(result.record["mean"][m]) for m in _SHOWN]
        lines.append(f"| {' | '.join([order, result.name, result.submitted_as, *values, fit])} |")
    return "\n".join(lines) + "\n"


def write_table(seasons: Path, season: Season) -> Path:
    """Write the table of a season's results and return its path."""
    path = season_folder(seasons, season.season) / TABLE
    write_text(path, table_text(season, read_results(seasons, season)))
    return path


def score_season(
    number: int,
    secret: Path,
    seasons: Path,
    *,
    predictions: Sequence[Path] = (),
    methods: Sequence[str] = (),
    metrics: Sequence[str] = (AUTO,),
    device: str = "auto",
) -> tuple[Path, list[str]]:
    """Score predictions folders of participants, and installed methods, which are run first on the training parts.

    Return the season's table and why some were not scored: a participant's mistake does not stop the others. Raises
    UserError for a season that is revealed, for nothing to score, and for predictions where streams are hidden.
    """
    season = read_season(seasons, number)
    if is_revealed(seasons, number):
        fix = "submit to the next season: whoever knows the seeds can make the truth"
        raise problem(f"season {number}", "a season whose seeds are secret", "revealed ones", fix)
    if not (predictions or methods):
        raise problem("season score", "--predictions or --methods", "neither", "name what to score")
    if predictions and season.streams == "hidden":
        fix = "take the method itself: --methods"
        raise problem("--predictions", "a season with published streams", "hidden ones", fix)
    selection, refused = select_metrics(tuple(metrics)), list[str]()
    with locked(secret / ".lock", secret, "a folder in which nobody else scores"):
        scenes = open_committed(secret, season)
        submitted = [(PREDICTIONS, folder) for folder in predictions]
        if methods:
            chosen = [get_method(name) for name in methods]
            on = choose_device_for(chosen, device)
            settings = Settings(runs_folder(secret), season.fit_seed, on, make_budget(season.budget), apart=Apart())
            failed = predict_all(open_committed(secret, season, training=True), chosen, settings)
            refused += [f"{name}: not fitted, see its log in {settings.out / 'logs'}" for name in sorted(failed)]
            ran = [settings.out / "predictions" / name for name in methods if name not in failed]
            submitted += [(METHOD, folder) for folder in ran]
        for way, folder in submitted:
            try:
                record = score_predictions(folder, scenes, selection, season.training_revisions)
                write_result(seasons, number, Result(way, record))
            except UserError as e:
                refused.append(str(e))
        return write_table(seasons, season), refused
