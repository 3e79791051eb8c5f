from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from changes import edit_json, files_in
from fake_renderer import render_fakes
from made_season import NUMBER, WORLDS, Made

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import locked, sha256_file
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.cli.season import make, publish
from spike4dgs.generators.make_dataset import make_dataset
from spike4dgs.generators.profiles import PROFILES, SPLIT_PROFILES, Job
from spike4dgs.leaderboard.season.season_file import OPENING_NAME, read_opening
from spike4dgs.leaderboard.season.secret_folder import pack_file, scene_folder, training_folder


def command(made: Made, worlds: tuple[str, ...] = WORLDS, number: int = NUMBER, **options: Any) -> int:
    given = {"profile": "tiny", "rendering": "paths", "secret": made.secret, "seasons": made.seasons, **options}
    return make(number, worlds=worlds, **given)


def test_the_commitments_are_those_of_what_was_made(once: Made) -> None:
    season, drawn = once.season, read_opening(once.secret / OPENING_NAME)
    assert season.opening_sha256 == sha256_file(once.secret / OPENING_NAME)
    assert [s.id for s in season.scenes] == ["car-9003-tiny", "turntable-9003-tiny"] == [s.scene for s in drawn.scenes]
    for scene, seed in zip(season.scenes, drawn.scenes, strict=True):
        whole = open_scene(scene_folder(once.secret, scene.id))
        assert str(whole.meta["source"]["seed"]) == seed.seed
        assert seed.rendering == "paths" and "soft" not in whole.meta["source"]["sampling"]
        assert scene.revision == whole.revision
        assert scene.pack_sha256 == sha256_file(pack_file(once.secret, scene.id, training=False))
        part = open_scene(training_folder(once.secret, scene.id))
        assert scene.training_revision == part.revision != whole.revision
        assert scene.training_pack_sha256 == sha256_file(pack_file(once.secret, scene.id, training=True))
    assert season.rendered_on["mitsuba_variant"] == "fake" and season.rendered_on["cpu"]
    assert (season.streams, season.budget, season.fit_seed, season.closes) == ("published", "0.02", 0, None)


def test_a_hidden_season_publishes_no_streams(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    render_fakes(monkeypatch)
    made = Made(tmp_path)
    assert command(made, worlds=("car",), budget="0.02", hide_streams=True) == 0
    assert made.season.streams == "hidden"
    with pytest.raises(UserError, match="expected published streams, found hidden ones"):
        publish(NUMBER, secret=made.secret, seasons=made.seasons, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_no_secret_is_in_the_public_folder(once: Made) -> None:
    drawn, public = read_opening(once.secret / OPENING_NAME), b"".join(files_in(once.seasons).values()).decode()
    assert list(files_in(once.seasons)) == [f"{NUMBER}/season.json"]
    for secret in (drawn.salt, *(s.seed for s in drawn.scenes)):
        assert secret not in public and f"{int(secret, 16 if secret == drawn.salt else 10):x}" not in public


def test_a_killed_run_goes_on_with_its_seeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    render_fakes(monkeypatch)
    made, rendered = Made(tmp_path), []

    def dying(jobs: Sequence[Job], out: Path, **options: Any) -> int:
        assert jobs[0].profile == SPLIT_PROFILES["tiny"], "light is split unless one says otherwise"
        if jobs[0].world == "turntable" and len(rendered) == 1:
            rendered.append("died")
            raise KeyboardInterrupt
        rendered.append(jobs[0].world)
        return make_dataset([replace(jobs[0], profile=PROFILES["tiny"])], out, **options)  # for the fake renderer

    monkeypatch.setattr("spike4dgs.generators.make_dataset.make_dataset", dying)
    given: dict[str, Any] = {"worlds": WORLDS, "profile": "tiny", "secret": made.secret, "seasons": made.seasons}
    with pytest.raises(KeyboardInterrupt):
        make(NUMBER, **given)
    drawn = (made.secret / OPENING_NAME).read_bytes()
    assert not made.seasons.exists(), "nothing is committed to before all is made"
    assert make(NUMBER, **given) == 0
    assert (made.secret / OPENING_NAME).read_bytes() == drawn
    assert rendered == ["car", "died", "car", "turntable"]
    assert made.season.opening_sha256 == sha256_file(made.secret / OPENING_NAME)


def test_two_processes_do_not_make_one_season(once: Made) -> None:
    message = "expected a folder in which nobody else makes a season, found a run in progress"
    with locked(once.secret / ".lock", "x", "free"), pytest.raises(UserError, match=message):
        command(once)


def test_commitments_never_change(made: Made, said: Any) -> None:
    before = files_in(made.root)
    assert command(made) == 0 and "complete, kept" in said()
    assert files_in(made.root) == before
    with pytest.raises(UserError, match=r"expected the commitment .* choose another number or --secret"):
        command(made, secret=made.root / "another")
    assert files_in(made.seasons) == {f"{NUMBER}/season.json": before[f"seasons/{NUMBER}/season.json"]}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"worlds": ("car",)}, "give the same arguments"),
        ({"number": 4}, "give the same arguments"),
        ({"profile": "small"}, "give the same arguments"),
        ({"rendering": "split"}, "give the same arguments"),
        ({"number": -1}, "number: expected a number from 0 up"),
        ({"worlds": ("car", "car")}, "--worlds: expected worlds, each once"),
        ({"worlds": ()}, "--worlds: expected worlds, each once, found none"),
        ({"closes": "soon"}, "--closes: expected a day"),
        ({"closes": "20270131"}, "--closes: expected a day"),
        ({"fit_seed": -1}, "--fit-seed: expected a number from 0 up"),
        ({"budget": "much"}, "--budget: expected"),
    ],
)
def test_other_arguments_are_refused(options: dict[str, Any], message: str, once: Made) -> None:
    with pytest.raises(UserError, match=message):
        command(once, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"profile": "smal"}, "--profile: expected one of"), ({"worlds": ("car", "vna")}, "world: expected one of")],
)
def test_a_typo_leaves_no_secret(options: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=message):
        command(Made(tmp_path), **options)
    assert not list(tmp_path.iterdir())


def test_another_version_of_the_code_does_not_finish_a_season(made: Made) -> None:
    edit_json(made.secret / OPENING_NAME, lambda opening: opening["harness"].update(commit="0" * 40))
    with pytest.raises(UserError, match="with the same version of the code"):
        command(made)
