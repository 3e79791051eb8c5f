"""`fault-table`: what the imperfections of an array cost, in dB at a held-out camera.

Each capture is that of an emulated array which shows one made scene, with one fault of one size. `fit` gets the capture
alone, its recordings under uniform light and in the dark included; the scene's truth judges what it rendered.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from spike4dgs.baselines.images.tfp import TFP
from spike4dgs.benchmark.environment import command_line, device_type, environment, harness
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import read_json, sha256_json, write_json, write_text
from spike4dgs.benchmark.method import DEFAULT_BUDGET, FitRequest, choose_device_for, get_method, make_budget
from spike4dgs.benchmark.metrics.measure import mean, score_image
from spike4dgs.benchmark.reports.figure import method_color, new_figure, save_figure
from spike4dgs.benchmark.runs.apart.messages import identity
from spike4dgs.benchmark.runs.predictions import open_predictions
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.generators.recorder.emulation.imperfections import Imperfections
from spike4dgs.generators.recorder.record import Emulation, record
from spike4dgs.generators.recorder.sources import Light
from spike4dgs.method.recordings.fit import PREDICTIONS, fit_recording
from spike4dgs.studies.kit.checkout import code_now
from spike4dgs.studies.kit.timing import markdown, write_csv

FLAT_RADIANCE = 0.7  # of the emulated uniform light
_EXACT = "none"
METRICS = ("psnr", "psnr_dynamic")


@dataclass(frozen=True)
class Case:
    """A fault, its size in words, and the options of `record --worse` that make it."""

    fault: str
    size: str
    worse: Mapping[str, float]
    lens: bool = False  # of the scene that was made with lenses

    @property
    def name(self) -> str:
        """The name of its folder."""
        return "-".join((*self.fault.split(), *self.size.split())).replace("%", "percent").replace("°", "deg")


CASES = (
    Case(_EXACT, "", {}),
    Case("clock offset", "3 ticks", {"offset_ticks": 3}),
    Case("clock offset", "30 ticks", {"offset_ticks": 30}),
    Case("clock drift", "20 ppm", {"drift_ppm": 20}),
    Case("clock drift", "5000 ppm", {"drift_ppm": 5000}),
    Case("dropped ticks", "0.1 %", {"dropped": 0.001}),
    Case("dropped ticks", "5 %", {"dropped": 0.05}),
    Case("bad pixels", "40 a camera", {"bad_pixels": 40}),
    Case("bad pixels", "400 a camera", {"bad_pixels": 400}),
    Case("gain", "2 %", {"gain": 0.02}),
    Case("gain", "10 %", {"gain": 0.1}),
    Case("poses", "0.1°", {"pose_deg": 0.1}),
    Case("poses", "1°", {"pose_deg": 1}),
    Case("poses", "2°", {"pose_deg": 2}),
    Case(
        "all of them",
        "small",
        {"offset_ticks": 3, "drift_ppm": 20, "dropped": 0.001, "bad_pixels": 40, "gain": 0.02, "pose_deg": 0.1},
    ),
)
LENS_CASES = (
    Case("lens", "known", {}, lens=True),
    Case("lens", "10 % wrong", {"lens": 0.1}, lens=True),
    Case("lens", "ignored", {"lens": 1}, lens=True),
)


@dataclass(frozen=True)
class Outcome:
    """The scores of a method's fit of a capture; `error` says why there are none."""

    case: Case
    method: str
    psnr: float | None
    psnr_dynamic: float | None
    error: str = ""


def fault_table(
    scene: Positional[Path],
    *,
    lens_scene: Path | None = None,
    methods: tuple[str, ...] = ("spike4dgs-x", "spk2img+stg"),
    out: Path = Path("runs/faults"),
    budget: str = DEFAULT_BUDGET,
    seed: int = 0,
    device: str = "auto",
) -> int:
    """Make captures of a scene worse on purpose, fit each, and tabulate the dB that a held-out camera loses.

    A killed run continues: give the same command again.

    Args:
        scene: A made scene with ground truth.
        lens_scene: The same scene made with `make-dataset --lens`, for the rows of lens distortion; its held-out camera
            is judged through its lens.
        methods: Methods by name.
        out: Folder for table.md, table.csv, table.json and table.png; captures and fits are kept there too.
        budget: quick, standard (4 times the steps), or a multiple of quick.
        seed: Seed of the imperfections and of the fits.
        device: auto, cpu or cuda.
    """
    truth = _with_truth(scene)
    curved = None if lens_scene is None else _with_truth(lens_scene)
    chosen = choose_device_for([get_method(name) for name in methods], device)
    of = {"scene": truth.revision, "budget": make_budget(budget).label, "seed": seed, "code": code_now()}
    of["device"] = device_type(chosen)
    _check_same(out / "about.json", of | ({"lens_scene": curved.revision} if curved else {}))
    found: list[Outcome] = []
    about = {"scene": truth.id, "budget": budget, "seed": seed, "command": command_line(), "harness": harness()}
    about["environment"] = environment(chosen)
    for case in (*CASES, *(LENS_CASES if curved else ())):
        shown = curved if curved and case.lens else truth
        capture = out / "captures" / case.name
        _capture(Imperfections(**case.worse), shown.root, capture, seed)
        for method in methods:
            folder = out / "fits" / case.name / method
            wanted = get_method(method)
            request = FitRequest(make_budget(budget), chosen, seed)
            run = partial(fit_recording, capture / "clip", wanted, folder, request, TFP)
            by = sha256_json(identity(wanted))
            found.append(Outcome(case, method, **_scored(run, folder, shown, by)))
            _write(out, found, about)
    print(f"table: {out}/{{table.md,table.csv,table.json,table.png}}")
    return 0


def _check_same(path: Path, about: dict[str, Any]) -> None:
    """Raise UserError where a folder has captures and fits of something else."""
    kept = read_json(path, "what captures and fits are of") if path.is_file() else {}
    if other := [name for name, value in about.items() if kept.get(name, value) != value]:
        raise problem(path.parent, f"captures and fits of this {other[0]}", "those of another", "choose another --out")
    write_json(path, {**kept, **about})


def _with_truth(scene: Path) -> Scene:
    opened = open_scene(scene)
    if not opened.targets:
        raise problem(scene, "a scene with ground truth", "none", "make one with `spike4dgs make-dataset`")
    return opened


def _capture(worse: Imperfections, scene: Path, out: Path, seed: int) -> None:
    """Record uniform light, darkness and the scene with an emulated array; a finished capture is kept."""
    if (out / "clip" / "manifest.json").exists():
        return
    shutil.rmtree(out, ignore_errors=True)
    flat, dark = out / "flat", out / "dark"
    shown = Emulation(scene, seed=seed)
    record(out=flat, mode="flat", emulation=shown, worse=worse)
    record(out=dark, mode="dark", emulation=shown, worse=worse)
    light = Light(flat_radiance=FLAT_RADIANCE, flat=flat, dark=dark)
    record(out=out / "clip", emulation=shown, light=light, worse=worse)


def _scored(fit: Callable[[], None], out: Path, truth: Scene, by: str) -> dict[str, Any]:
    """Fit a capture and score its held-out cameras against the truth; finished scores of a fit `by` the same stay.

    `by` is a digest of the method's settings, weights and code.
    """
    kept = out / "scores.json"
    if kept.is_file():
        if (found := read_json(kept, "the scores of a fit")).pop("by", None) == by:
            return found
        shutil.rmtree(out)
    try:
        fit()
        scores: dict[str, Any] = {**_scores(out / PREDICTIONS, truth), "error": ""}
    except UserError as e:  # the next run tries again
        return {**dict.fromkeys(METRICS), "error": str(e)}
    write_json(kept, {**scores, "by": by})
    return scores


def _scores(folder: Path, truth: Scene) -> dict[str, float | None]:
    """Return the mean scores over all targets; for `psnr_dynamic` over those with a moving region, None without any."""
    predictions = open_predictions(folder, truth.targets)
    images = [
        score_image(truth.ground_truth(t), predictions.read(t), truth.moving(t), metrics=METRICS) for t in truth.targets
    ]
    return {m: mean(image[m] for image in images if m in image) for m in METRICS}


def _write(out: Path, found: Sequence[Outcome], about: Mapping[str, Any]) -> None:
    """Write the table so far in all its forms."""
    methods = list(dict.fromkeys(o.method for o in found))
    exact = {o.method: o for o in found if o.case.fault == _EXACT}
    write_json(out / "table.json", {**about, "outcomes": [asdict(o) for o in found]})
    rows = []
    for o in found:
        values = [*(getattr(o, m) for m in METRICS), *_lost(o, exact[o.method])]
        texts = ("" if v is None else f"{v:.4f}" for v in values)
        rows.append([o.case.fault, o.case.size, o.method, *texts, o.error])
    columns = ["fault", "size", "method", *METRICS, *(f"{m}_lost" for m in METRICS), "error"]
    write_csv(out / "table.csv", columns, rows)
    write_text(out / "table.md", _markdown(found, methods, exact))
    _plot(out / "table.png", found, methods, exact)


def _lost(outcome: Outcome, exact: Outcome) -> list[float | None]:
    """Return the dB lost beside the capture without faults, by `METRICS`; None where there is no score."""
    pairs = [(getattr(exact, m), getattr(outcome, m)) for m in METRICS]
    return [None if a is None or b is None else a - b for a, b in pairs]


def _markdown(found: Sequence[Outcome], methods: Sequence[str], exact: Mapping[str, Outcome]) -> str:
    header = ["fault", "size", *(f"{m}, dB" for m in methods), *(f"{m}, moving, dB" for m in methods)]
    by_case: dict[str, dict[str, Outcome]] = {}
    for o in found:
        by_case.setdefault(o.case.name, {})[o.method] = o
    rows = []
    for outcomes in by_case.values():
        case = next(iter(outcomes.values())).case
        cells = [_cell(outcomes.get(method), exact, k) for k in range(len(METRICS)) for method in methods]
        rows.append([case.fault, case.size, *cells])
    errors = [f"- {o.case.fault}, {o.case.size}, {o.method}: {o.error}" for o in found if o.error]
    return "\n".join([*markdown(header, rows), "", *errors]).rstrip() + "\n"


def _cell(outcome: Outcome | None, exact: Mapping[str, Outcome], k: int) -> str:
    """Return the score without faults, the change of any other, or a dash."""
    if outcome is None or (value := getattr(outcome, METRICS[k])) is None:
        return "-"
    if outcome.case.fault == _EXACT:
        return f"{value:.2f}"
    lost = _lost(outcome, exact[outcome.method])[k]
    return "-" if lost is None else f"{-lost:+.2f}"


def _plot(path: Path, found: Sequence[Outcome], methods: Sequence[str], exact: Mapping[str, Outcome]) -> None:
    """Plot the dB lost where things move, a bar for each fault and method."""
    labels = {o.case.name: f"{o.case.fault}, {o.case.size}" for o in found if o.case.fault != _EXACT}
    names = list(labels)
    figure = new_figure((8.0, 1.2 + 0.35 * max(1, len(names))))
    axis = figure.subplots()
    width = 0.8 / len(methods)
    for i, method in enumerate(methods):
        lost = {o.case.name: _lost(o, exact[method])[1] for o in found if o.method == method}
        bars = [(y, value) for y, name in enumerate(names) if (value := lost.get(name)) is not None]
        shift = (i - (len(methods) - 1) / 2) * width
        axis.barh([y + shift for y, _ in bars], [v for _, v in bars], width, label=method, color=method_color(i))
    axis.set_yticks(range(len(names)), list(labels.values()))
    axis.invert_yaxis()
    axis.axvline(0, color="black", linewidth=0.8)
    axis.set_xlabel("dB lost where things move, held-out camera")
    axis.legend(loc="lower right")
    save_figure(figure, path)
