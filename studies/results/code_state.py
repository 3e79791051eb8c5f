"""Which code makes the numbers: the checkout's commit, whether code was changed since, and a digest of it."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path

from spike4dgs import baselines, benchmark, generators, method
from spike4dgs.baselines.recipes import METHODS as THEIRS
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import sha256_json
from spike4dgs.benchmark.method import get_method
from spike4dgs.benchmark.runs.method_code import sources_sha256
from spike4dgs.benchmark.runs.refinement import SUFFIX as REFINED
from spike4dgs.leaderboard import truth_check
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.images.base import Learned, learned_from
from spike4dgs.method.recipes import METHODS as OURS
from spike4dgs.method.tuned import is_tuned
from spike4dgs.studies import images as studied_images
from spike4dgs.studies.results.plan import CEILING
from spike4dgs.studies.results.records import DIGITS
from spike4dgs.studies.results.tables import ceilings
from spike4dgs.studies.results.tables import images as image_rows
from spike4dgs.studies.speed_error import images as held_out_images

ROOT = Path(__file__).resolve().parents[2]
# What decides about a number. Records, pages and tests may change while a sweep runs.
CODE = (
    "benchmark",
    "method",
    "baselines",
    "generators",
    "leaderboard/truth_check.py",
    "studies/results/*.py",
    "studies/images.py",
    "studies/sensors.py",
    "studies/speed_error/images.py",
    "pyproject.toml",
    "constraints.txt",
)
_DO = "clone the repository, and run `pip install -e .` there"


@dataclass(frozen=True)
class CodeState:
    """The commit of a checkout, and whether its code differs from it."""

    commit: str
    dirty: bool


def find_root() -> Path:
    """Return the root of the checkout that this code runs from. Raises UserError where it is installed without one."""
    if not (ROOT / "docs" / "results").is_dir():
        raise problem("report results", "a checkout with its docs", f"an installation in {ROOT}", _DO)
    return ROOT


def code_state(root: Path) -> CodeState:
    """Return the state of the code of a checkout. Raises UserError where git does not tell it."""
    commit, changes = _git(root, "rev-parse", "HEAD"), _git(root, "status", "--porcelain", "--", *CODE)
    return CodeState(commit.strip()[:DIGITS], bool(changes.strip()))


def check_clean(state: CodeState, allow_dirty: bool) -> None:
    """Raise UserError where code was changed since the commit, unless that is allowed."""
    if state.dirty and not allow_dirty:
        fix = "commit it, or pass --allow-dirty: then the records say so"
        raise problem("the checkout", f"the code of commit {state.commit}", "changes that are not committed", fix)


def code_digest(row: str) -> str:
    """Return a digest of what a row's method and its scores come from: sources, searched settings, weights in use."""
    if row == CEILING:
        return sources_sha256([benchmark, generators, truth_check, ceilings])[:DIGITS]
    row = row.removesuffix(REFINED).partition("[")[0]  # its name has its settings
    scoring = [studied_images, held_out_images, image_rows] if row.endswith(image_rows.SUFFIX) else []
    found = sources_sha256([benchmark, method, *([] if row in OURS else [baselines]), *scoring])
    settings = [get_method(row).params["settings"]] if is_tuned(row) else []
    weights = [used.sha256 for used in _learned(row) if used]
    return (sha256_json([found, *settings, *weights]) if settings or weights else found)[:DIGITS]


def _learned(row: str) -> list[Learned | None]:
    """Return the weights in use of each network of a row; None for those that are missing."""
    if row.endswith(image_rows.SUFFIX):
        return [image_rows.maker_of(row).learned()]
    used = {**OURS, **THEIRS}.get(row)
    if not isinstance(used, RecipeMethod):
        return []
    return [used.images.learned(), *(learned_from(n.in_use, n.read_card) for n in used.initialization.networks)]


def _git(root: Path, *arguments: str) -> str:
    try:
        done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired) as e:
        raise problem(root, "a git checkout", f"{type(e).__name__} of git", _DO) from None
    if done.returncode:
        raise problem(root, "a git checkout", done.stderr.strip()[:200] or "an error of git", _DO)
    return done.stdout
