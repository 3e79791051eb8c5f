"""`report tuning`: one search for every row over the same knobs, on scenes that no table has.

OUT/ROW.json keeps a row's trials; a killed search goes on from them. OUT/tuning.md compares, OUT/ROW@STEPS.csv lists.
With `--write` a checkout gets the best settings as rows X.tuned (`tuned.json` beside the recipes), the table and the
trials.

The first trial is the recipe as it is, so that the same fits measure what the search gains. Optuna's tree of Parzen
estimators proposes the others; a trial ends after a scene at which it lies below the median of the earlier ones. Fits
have the steps that they have in tables: what is best at a quarter of them is not best there.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from spike4dgs.baselines import recipes as theirs
from spike4dgs.benchmark.environment import command_line, cpu_name, device_type, harness, utc_now
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_json, sha256_json, write_json, write_text
from spike4dgs.benchmark.method import DEFAULT_BUDGET, choose_device_for, get_method, make_budget
from spike4dgs.benchmark.runs.record import check_scenes
from spike4dgs.benchmark.scene.scene import Scene, open_scenes
from spike4dgs.benchmark.variants import DEVELOPMENT_VARIANTS
from spike4dgs.method import recipes as ours
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.tuned import read_tuned
from spike4dgs.studies.kit.blocks import table_rows, with_block
from spike4dgs.studies.kit.checkout import code_now, find_checkout
from spike4dgs.studies.kit.timing import markdown, write_csv
from spike4dgs.studies.tuning.knobs import Values, as_settings, knobs_of, start_of
from spike4dgs.studies.tuning.trial_fits import METRICS, Fit, fit_by, keeping

TRIALS = 24
_RANDOM = 8  # trials before the search follows what it has seen
Trial = dict[str, Any]  # number, knobs, scores by scene (dB), seconds


def tuning(
    scenes: Positional[tuple[Path, ...]],
    *,
    rows: tuple[str, ...],
    out: Path = Path("runs/tuning"),
    trials: int = TRIALS,
    budget: str = DEFAULT_BUDGET,
    seed: int = 0,
    device: str = "auto",
    write: bool = False,
) -> int:
    """Search for better settings of recipes, every row by the same search; OUT/tuning.md compares.

    A killed search resumes: give the same command again.

    Args:
        scenes: Scene folders of development variants, as of `make-dataset --track dev-small`.
        rows: Recipes by name.
        out: Folder for the trials.
        trials: Trials of each row, the recipe as it is among them.
        budget: Steps of a fit, as a multiple of quick.
        seed: Seed of fits and of the search.
        device: auto, cpu or cuda.
        write: Write what OUT has found into this checkout: recipes X.tuned, and the page of results.
    """
    opened = open_scenes(scenes)
    check_scenes(opened)
    for scene in opened:
        if (variant := scene.meta["source"].get("variant")) not in DEVELOPMENT_VARIANTS:
            expected = f"a development variant ({', '.join(map(str, DEVELOPMENT_VARIANTS))})"
            raise problem(scene.id, expected, f"variant {variant}", "tune on scenes that no table has")
    recipes = [_recipe(name) for name in rows]
    chosen = choose_device_for(recipes, device)
    for recipe in recipes:
        method = keeping(recipe, chosen)
        of = {scene.id: scene.revision for scene in opened}
        about = {"row": method.name, "scenes": of, "budget": make_budget(budget).label, "seed": seed}
        about |= {"device": device_type(chosen), "code": code_now(), "method": sha256_json(recipe.params)}
        search(method, opened, out / f"{method.name}.json", about, trials, fit_by(seed, chosen, budget), print)
        write_results(out)
    print(f"table: {out / 'tuning.md'}")
    if write:
        publish(out, find_checkout("report tuning --write"))
    return 0


def search(
    method: RecipeMethod,
    scenes: Sequence[Scene],
    path: Path,
    about: Mapping[str, Any],
    trials: int,
    fit: Fit,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Run, or go on with, the search of a recipe; return what `path` keeps of it.

    `about` says what makes trials comparable. Raises UserError where `path` has a search of something else, and where
    the recipe as it is fails.
    """
    record: dict[str, Any] = {**about, "commit": harness()["commit"], "cpu": cpu_name(), "trials": []}
    if path.is_file():
        found = read_json(path, "a search")
        if any(found.get(name) != value for name, value in about.items()):
            raise problem(path, f"a search of {dict(about)}", "another", "choose another --out")
        record = found
    done: list[Trial] = record["trials"]
    while len(done) < trials:
        start, knobs = time.perf_counter(), propose(method, done, int(about["seed"]))
        scores = _scores(variant(method, knobs), scenes, done, fit)
        if not done and not all(any(found) for found in scores.values()):
            fix = "see the message above"
            raise problem(path, "a fit of the recipe as it is on every scene", "one that failed", fix)
        done.append(
            {
                "number": len(done),
                "knobs": knobs,
                "scores": scores,
                "seconds": round(time.perf_counter() - start, 1),
                "at": utc_now(),
            }
        )
        write_json(path, {**record, "command": command_line()})
        best = best_of(done, len(scenes))
        say(
            f"{method.name} {len(done)}/{trials}: {gain_of(done[-1], done[0]):+.2f} dB"
            f"{'' if len(scores) == len(scenes) else ' (ended early)'}, best {gain_of(best, done[0]):+.2f} dB"
        )
    return record


def propose(method: RecipeMethod, done: Sequence[Trial], seed: int) -> dict[str, Any]:
    """Return the knobs of the next trial: of the recipe as it is, then what Optuna proposes, a function of `done`."""
    try:
        import optuna
    except ImportError:
        raise problem("report tuning", "the package optuna", "none", "pip install 'spike4dgs[tuning]'") from None
    knobs = knobs_of(method.settings)
    if not done:
        return start_of(method.settings)
    space: dict[str, optuna.distributions.BaseDistribution] = {
        k.name: optuna.distributions.CategoricalDistribution(k.choices)
        if k.choices
        else optuna.distributions.FloatDistribution(k.low, k.high, log=True)
        for k in knobs
    }
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    sampler = optuna.samplers.TPESampler(n_startup_trials=_RANDOM, multivariate=True, seed=1000 * seed + len(done))
    study = optuna.create_study(direction="maximize", sampler=sampler)
    for trial in done:
        study.add_trial(
            optuna.trial.create_trial(params=dict(trial["knobs"]), distributions=space, value=gain_of(trial, done[0]))
        )
    return dict(study.ask(space).params)


def variant(method: RecipeMethod, knobs: Values) -> RecipeMethod:
    """Return a recipe with the settings that knobs give it; itself where these are its own."""
    changed = as_settings(knobs, method.settings)
    return method if knobs == start_of(method.settings) else method.with_settings(changed, f"{method.name}.trial")


def _scores(method: RecipeMethod, scenes: Sequence[Scene], done: Sequence[Trial], fit: Fit) -> dict[str, list[float]]:
    """Return the scores of a trial by scene, in dB; of all scenes unless it falls behind."""
    scores: dict[str, list[float]] = {}
    for scene in scenes:
        found = fit(method, scene)
        scores[scene.id] = [round(found[name], 4) for name in METRICS]
        earlier = [_mean(t["scores"], scores) for t in done if set(scores) <= set(t["scores"])]
        if len(earlier) >= _RANDOM and _mean(scores, scores) < statistics.median(earlier):
            break
    return scores


def _mean(scores: Mapping[str, Sequence[float]], of: Mapping[str, Any]) -> float:
    return statistics.fmean(statistics.fmean(scores[name]) for name in of)


def gain_of(trial: Trial, first: Trial) -> float:
    """Return what is searched for: the mean of PSNR and of PSNR where things move, above the first trial's, in dB.

    Of a trial that ended early, over the scenes that it saw.
    """
    return _mean(trial["scores"], trial["scores"]) - _mean(first["scores"], trial["scores"])


def best_of(done: Sequence[Trial], scenes: int) -> Trial:
    """Return the best trial among those that saw all scenes; the first one always did."""
    return max((t for t in done if len(t["scores"]) == scenes), key=lambda t: gain_of(t, done[0]))


def _recipe(name: str) -> RecipeMethod:
    method = get_method(name)
    if not isinstance(method, RecipeMethod):
        raise problem("--rows", "recipes", name, "`spike4dgs methods` lists them")
    return method


def write_results(out: Path) -> None:
    """Write OUT/tuning.md, what each search in OUT found, and its trials as OUT/ROW@STEPS.csv."""
    whole = "whole / moving, dB"
    columns = ("row", "steps", f"as it is: {whole}", f"best: {whole}", "best trial", "hours", "changed")
    rows = []
    for record in _records(out):
        done = record["trials"]
        first, best = done[0], best_of(done, len(record["scenes"]))
        changed = ", ".join(f"{k} {_short(v)}" for k, v in best["knobs"].items() if v != first["knobs"][k])
        steps = _short(record["budget"])
        cells = (steps, _pair(first), _pair(best), f"{best['number'] + 1} of {len(done)}", _hours(done), changed or "-")
        rows.append((f"`{record['row']}`", *cells))
        heads = ["trial", *first["knobs"], *(f"{s} {m}" for s in record["scenes"] for m in METRICS), "seconds"]
        write_csv(out / f"{record['row']}@{steps}.csv", heads, [_line(trial, record["scenes"]) for trial in done])
    write_text(out / "tuning.md", "\n".join([*markdown(columns, rows), ""]))


def _line(trial: Trial, scenes: Iterable[str]) -> list[Any]:
    """Return a trial's line of the CSV; scenes that it did not see have empty cells."""
    scores = [score for scene in scenes for score in trial["scores"].get(scene, [None] * len(METRICS))]
    return [trial["number"], *map(_short, trial["knobs"].values()), *scores, trial["seconds"]]


def publish(out: Path, root: Path) -> None:
    """Write the best settings of the searches in OUT into a checkout, and the table and the trials into its docs.

    What the page has of other rows, and of the same rows at other numbers of steps, stays. Raises UserError, before
    anything is written, where a search has fewer than `TRIALS` trials: every row there had as many.
    """
    records = _records(out)
    if short := [f"{r['row']}, {len(r['trials'])}" for r in records if len(r["trials"]) < TRIALS]:
        fix = f"go on with --trials {TRIALS}, or move its file elsewhere"
        raise problem(out, f"searches of {TRIALS} trials", "; ".join(short), fix)
    for folder, rows in (
        ("method", ours.RECIPES),
        ("baselines", (*theirs.RECIPES, *theirs.CALIBRATED, *theirs.PUBLISHED)),
    ):
        path = root / folder / "tuned.json"
        found, names = read_tuned(path), {recipe.name for recipe in rows}
        for record in records:
            if record["row"] in names:
                found[record["row"]] = _found(record)
        write_json(path, dict(sorted(found.items())))
    page = root / "docs" / "results" / "tuning.md"
    text = page.read_text(encoding="utf-8")
    head, rule, *new = (out / "tuning.md").read_text(encoding="utf-8").splitlines()
    lines = {tuple(line.split(" | ")[:2]): line for line in [*table_rows(text, "searches"), *new]}
    shown = [lines[key] for key in sorted(lines)]
    write_text(page, with_block(text, "searches", [head, rule, *shown]))
    for path in sorted(out.glob("*.csv")):
        write_text(root / "docs" / "results" / "tables" / "tuning" / path.name, path.read_text(encoding="utf-8"))


def _found(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the best settings of a search, as they differ from the recipe's own, and what they cost."""
    done, method = record["trials"], _recipe(record["row"])
    best = best_of(done, len(record["scenes"]))
    settings = {} if best is done[0] else as_settings(best["knobs"], method.settings)
    own = {f"{part}.{name}": value for part, s in method.settings.items() for name, value in asdict(s).items()}
    return {
        "settings": {name: value for name, value in settings.items() if value != own[name]},
        "gain_db": round(gain_of(best, done[0]), 2),
        "trials": len(done),
        "hours": float(_hours(done)),
        "budget": record["budget"],
        "scenes": list(record["scenes"]),
        "commit": record["commit"],
    }


def _records(out: Path) -> list[dict[str, Any]]:
    return [read_json(path, "a search") for path in sorted(out.glob("*.json"))]


def _hours(done: Sequence[Trial]) -> str:
    return f"{sum(t['seconds'] for t in done) / 3600:.2f}"


def _pair(trial: Trial) -> str:
    whole, moving = (statistics.fmean(s[k] for s in trial["scores"].values()) for k in (0, 1))
    return f"{whole:.2f} / {moving:.2f}"


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
