"""Make a season: draw secret seeds, make the hidden scenes, and write the commitments to them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path

from spike4dgs.benchmark.environment import cpu_name, harness, utc_now
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import locked
from spike4dgs.benchmark.method import make_budget
from spike4dgs.benchmark.runs.apart.training_part import write_training_part
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.leaderboard.season.season_file import (
    OPENING_NAME,
    HiddenScene,
    Opening,
    Rendering,
    Season,
    Seed,
    draw_opening,
    is_announced,
    read_opening,
    read_season,
    season_folder,
    write_season,
    write_secret,
)
from spike4dgs.leaderboard.season.secret_folder import pack_file, pack_scene, scene_folder, training_folder


def make_season(
    number: int,
    worlds: Sequence[str],
    secret: Path,
    seasons: Path,
    make_scene: Callable[[Seed, Path], object],
    *,
    profile: str = "small",
    rendering: Rendering = "split",
    closes: str | None = None,
    hide_streams: bool = False,
    budget: str = "quick",
    fit_seed: int = 0,
) -> bool:
    """Draw secret seeds, make a hidden scene of each world, and write the commitments to them.

    `make_scene` makes the scene of a seed below a folder: rendering is another room's work. Return whether the
    commitments are new: those of a season are never changed, and a killed run goes on with its seeds. Raises UserError
    for bad arguments, and where `secret` is another season's.
    """
    _check(number, worlds, closes, fit_seed)
    make_budget(budget)
    with locked(secret / ".lock", secret, "a folder in which nobody else makes a season"):
        drawn = _opening(number, worlds, profile, rendering, secret)
        if is_announced(seasons, number):
            if (committed := read_season(seasons, number).opening_sha256) != drawn.sha256:
                where, expected = season_folder(seasons, number), f"the commitment {drawn.sha256[:16]}... of --secret"
                raise problem(where, expected, f"{committed[:16]}...", "choose another number or --secret")
            return False
        for seed in drawn.scenes:
            make_scene(seed, scene_folder(secret, seed.scene).parent)
        scenes = [open_scene(scene_folder(secret, seed.scene)) for seed in drawn.scenes]
        write_season(
            seasons,
            Season(
                season=number,
                opens=utc_now(),
                closes=closes,
                streams="hidden" if hide_streams else "published",
                budget=budget,
                fit_seed=fit_seed,
                opening_sha256=drawn.sha256,
                harness=drawn.harness,
                # Elsewhere the last bits of a rendering may differ.
                rendered_on={**scenes[0].meta["source"].get("versions", {}), "cpu": cpu_name()},
                scenes=tuple(_commit(*pair, secret) for pair in zip(drawn.scenes, scenes, strict=True)),
            ),
        )
    return True


def _check(number: int, worlds: Sequence[str], closes: str | None, fit_seed: int) -> None:
    if number < 0:
        raise problem("number", "a number from 0 up", str(number), "correct it")
    if fit_seed < 0:
        raise problem("--fit-seed", "a number from 0 up", str(fit_seed), "correct it")
    if not worlds or len(set(worlds)) < len(worlds):
        raise problem("--worlds", "worlds, each once", " ".join(worlds) or "none", "see `spike4dgs worlds`")
    try:
        if closes and date.fromisoformat(closes).isoformat() != closes:  # Python reads 20270131 too
            raise ValueError
    except ValueError:
        raise problem("--closes", "a day such as 2027-01-31", repr(closes), "correct it") from None


def _opening(number: int, worlds: Sequence[str], profile: str, rendering: Rendering, secret: Path) -> Opening:
    """Return the opening in SECRET, or a new one, written before anything is rendered: a killed run keeps its seeds.

    Raises UserError where the one in SECRET is for another season, other scenes or other code.
    """
    path = secret / OPENING_NAME
    if not path.exists():
        write_secret(secret, draw_opening(number, worlds, profile, rendering))
    drawn = read_opening(path)
    ways = {(s.profile, s.rendering) for s in drawn.scenes}
    found = (drawn.season, [s.world for s in drawn.scenes], ways, drawn.harness)
    expected = (number, list(worlds), {(profile, rendering)}, harness())
    if found != expected:
        fix = "give the same arguments with the same version of the code, or another --secret"
        raise problem(path, f"season, worlds, profile, rendering and code {expected}", str(found), fix)
    return drawn


def _commit(seed: Seed, scene: Scene, secret: Path) -> HiddenScene:
    """Write a scene's training part and both tars; return the commitments to them."""
    part = write_training_part(scene, training_folder(secret, scene.id))
    return HiddenScene(
        id=scene.id,
        world=seed.world,
        variant=seed.variant,
        profile=seed.profile,
        revision=scene.revision,
        pack_sha256=pack_scene(scene, pack_file(secret, scene.id, training=False)),
        training_revision=part.revision,
        training_pack_sha256=pack_scene(part, pack_file(secret, scene.id, training=True)),
    )
