"""`report tuning`: knobs that leave a recipe's work and knowledge alone, and a search that resumes and finds."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from changes import files_in
from hypothesis import given, settings
from hypothesis import strategies as st

from spike4dgs.baselines import recipes as theirs
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import find_methods, get_method
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.variants import DEVELOPMENT_VARIANTS
from spike4dgs.method import recipes as ours
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.images.training import make_training_images
from spike4dgs.method.settings import override
from spike4dgs.method.starts.base import StartRequest
from spike4dgs.method.tuned import read_tuned, tuned
from spike4dgs.studies.tuning.knobs import STEPS_OF_TWO, as_settings, knobs_of, start_of
from spike4dgs.studies.tuning.search import (
    TRIALS,
    best_of,
    gain_of,
    publish,
    search,
    tuning,
    variant,
    write_results,
)
from spike4dgs.studies.tuning.trial_fits import fit_by, keeping

ROWS = ("tfp+stg", "tfi+4dgs", "spk2img+d3dgs", "dy-spikenerf", "spike4dgs", "spike4dgs-x", "tfp+rig-flat+4dgs")


@pytest.mark.parametrize("name", ROWS)
def test_the_first_trial_is_the_recipe_as_it_is(name):
    method = get_method(name)
    settings = method.settings
    assert override(settings, as_settings(start_of(settings), settings), "start") == settings
    assert variant(method, start_of(settings)) is method


def test_every_recipe_lies_in_the_space_of_its_search():
    for name, method in find_methods().items():
        for knob in knobs_of(getattr(method, "settings", {})):
            start = knob.start(method.settings)
            assert start in knob.choices if knob.choices else knob.low <= start <= knob.high, (name, knob.name)


def test_views_of_a_step_change_only_where_the_number_of_steps_can_follow():
    found = {name: {k.name for k in knobs_of(getattr(m, "settings", {}))} for name, m in find_methods().items()}
    with_views = {name for name, knobs in found.items() if "views_per_step" in knobs}
    assert "tfp+stg" in with_views and "tfp+static" not in with_views
    assert all("static_share" in found[name] for name in with_views)


@pytest.mark.parametrize("name", ["tfp+stg", "spike4dgs", "spike4dgs-x", "tfi+4dgs"])
@settings(max_examples=20, deadline=None)
@given(data=st.data())
def test_no_knob_gives_more_work_or_knowledge(name, data):
    method = get_method(name)
    knobs = {}
    for knob in knobs_of(method.settings):
        values = st.sampled_from(knob.choices) if knob.choices else st.floats(knob.low, knob.high)
        knobs[knob.name] = data.draw(values, label=knob.name)
    changed = variant(method, knobs)

    def work(m):
        trainer = m.settings["trainer"]
        return (trainer.coarse_steps + trainer.fine_steps) * {2: 1.0, 4: STEPS_OF_TWO}[trainer.views_per_step]

    assert work(changed) == pytest.approx(work(method), abs=STEPS_OF_TWO)
    assert changed.given == method.given
    assert changed.settings["images"] == method.settings["images"]  # as many images
    own, new = method.settings["trainer"], changed.settings["trainer"]
    assert new.lr_means / own.lr_means == pytest.approx(knobs["rates"])
    assert new.lr_means_last / own.lr_means_last == pytest.approx(knobs["rates"])
    assert (new.lr_last, new.lr_poses) == (knobs["last_rate"], own.lr_poses)


def test_images_and_starts_are_made_once_and_stay_the_same(small_scene):
    scene, calls = open_scene(small_scene).training, []
    method = get_method("tfp+rig-flat+stg")
    rate = method.images.rate
    counted = replace(method.images, rate=lambda *args: (calls.append(args[1]), rate(*args))[1])
    parts = replace(method.parts, images={**method.parts.images, "tfp": counted})
    kept = keeping(RecipeMethod(method.recipe, parts), "cpu")
    made = [make_training_images(scene, scene.cameras, kept.images, method.settings["images"], "cpu") for _ in range(2)]
    own = make_training_images(scene, scene.cameras, method.images, method.settings["images"], "cpu")
    assert torch.equal(made[0].images, own.images) and torch.equal(made[1].images, own.images)
    assert len(calls) == own.images.shape[0] * own.images.shape[1]
    request = StartRequest(scene, 0, method.settings["initialization"])
    first = kept.initialization.start(request)
    assert kept.initialization.start(request) is first
    assert np.array_equal(first.points, method.initialization.start(request).points)


def test_the_times_of_tracking_share_the_same_steps():
    method = get_method("tfp+d3dgs")
    found = as_settings({**start_of(method.settings), "times": 24}, method.settings)
    later, own = found["motion.later_steps"], method.settings["motion"].later_steps
    assert later / found["images.time_spacing_ticks"] == pytest.approx(own / 16, rel=0.02)


class _Scene:
    """All that the search itself reads of a scene."""

    def __init__(self, name):
        self.id = name


def _fit(method, scene):
    """Return scores with one best rate, so that the search has something to find."""
    off = math.log(method.settings["trainer"].lr_means / 4.8e-4)  # three times tfp+stg's own
    level = 30 if scene.id == "a" else 35
    return {"psnr": level - off**2, "psnr_dynamic": level - 4 - off**2}


ABOUT = {"row": "tfp+stg", "scenes": {"a": "1", "b": "2"}, "budget": 0.25, "seed": 0}
SCENES = [_Scene("a"), _Scene("b")]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A search of one row, and its folder."""
    pytest.importorskip("optuna")
    out = tmp_path_factory.mktemp("tuning")
    return search(get_method("tfp+stg"), SCENES, out / "tfp+stg.json", ABOUT, TRIALS, _fit, print), out


def test_a_search_finds_the_better_rate(whole):
    done = whole[0]["trials"]
    assert gain_of(done[0], done[0]) == 0
    best = best_of(done, 2)
    assert gain_of(best, done[0]) > 0.9 * math.log(3) ** 2
    assert 1.8 < best["knobs"]["rates"] < 5
    assert any(len(trial["scores"]) == 1 for trial in done[8:])  # those that fell behind ended early


def test_a_killed_search_goes_on_as_if_nothing_had_happened(whole, tmp_path):
    path = tmp_path / "tfp+stg.json"
    for trials in (3, 11, TRIALS):
        found = search(get_method("tfp+stg"), SCENES, path, ABOUT, trials, _fit, print)
    same = ("number", "knobs", "scores")
    assert [[t[k] for k in same] for t in found["trials"]] == [[t[k] for k in same] for t in whole[0]["trials"]]
    with pytest.raises(UserError, match="another"):
        search(get_method("tfp+stg"), SCENES, path, {**ABOUT, "seed": 1}, 24, _fit, print)


def test_a_first_trial_that_fails_on_a_scene_is_no_search(tmp_path):
    """Else all others would be compared with 0 dB."""

    def fit(method, scene):
        return _fit(method, scene) if scene.id == "a" else {"psnr": 0.0, "psnr_dynamic": 0.0}

    path = tmp_path / "tfp+stg.json"
    with pytest.raises(UserError, match="a fit of the recipe as it is on every scene, found one that failed"):
        search(get_method("tfp+stg"), SCENES, path, ABOUT, TRIALS, fit, print)
    assert not path.exists()


def test_a_recipe_without_its_weights_is_not_searched(small_scene, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.delenv("SPIKE4DGS_WEIGHTS", raising=False)
    with pytest.raises(UserError, match=r"ssir\+stg on pattern-0: expected a fit"):
        fit_by(0, "cpu", "0.02")(get_method("ssir+stg"), open_scene(small_scene))


KEPT = "| `tfp+stg` | 1 | of another search |"


@pytest.fixture
def page(tmp_path):
    """The page of searches, in a folder with what else of a checkout `publish` changes."""
    for folder in ("method", "baselines"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "tuned.json").write_text("{}")
    page = tmp_path / "docs" / "results" / "tuning.md"
    page.parent.mkdir(parents=True)
    old = "\n".join(["| row |", "| --- |", "| `tfp+stg` | 0.25 | old |", KEPT])
    page.write_text(f"before\n<!-- searches -->\n{old}\n<!-- end searches -->\nafter\n")
    return page


def test_a_search_of_fewer_trials_is_not_published(whole, page, tmp_path):
    (out := tmp_path / "out").mkdir()
    (out / "tfp+stg.json").write_text(json.dumps({**whole[0], "trials": whole[0]["trials"][:12]}))
    write_results(out)
    before = files_in(tmp_path)
    with pytest.raises(UserError, match="expected searches of 24 trials, found tfp.stg, 12; go on with --trials 24"):
        publish(out, tmp_path)
    assert files_in(tmp_path) == before


def test_the_best_settings_become_a_row(whole, page, tmp_path):
    record, out = whole
    write_results(out)
    publish(out, tmp_path)
    assert read_tuned(tmp_path / "method" / "tuned.json") == {}
    (row,) = tuned(theirs.RECIPES, read_tuned(tmp_path / "baselines" / "tuned.json"))
    best = best_of(record["trials"], 2)
    assert row.name == "tfp+stg.tuned"
    assert row.settings["trainer.lr_means"] == pytest.approx(1.6e-4 * best["knobs"]["rates"])
    text = page.read_text()
    assert f"| {best['number'] + 1} of {TRIALS} |" in text, "a best trial among the last says that the search went on"
    assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text
    assert text.index("| `tfp+stg` | 0.25 |") < text.index(KEPT) and text.count("\n| ") == 4
    assert (page.parent / "tables" / "tuning" / "tfp+stg@0.25.csv").read_text().count("\n") == TRIALS + 1


def test_a_search_at_the_papers_steps_is_listed_too(whole, tmp_path):
    (tmp_path / "tfp+stg.json").write_text(json.dumps({**whole[0], "budget": "paper"}))
    write_results(tmp_path)
    assert "| `tfp+stg` | paper |" in (tmp_path / "tuning.md").read_text()
    assert (tmp_path / "tfp+stg@paper.csv").is_file()


def test_scenes_of_tables_are_refused(small_scene):
    with pytest.raises(UserError, match="development variant"):
        tuning((small_scene,), rows=("tfp+stg",))


@pytest.mark.parametrize("recipes", [theirs, ours])
def test_every_tuned_row_had_the_whole_search(recipes):
    for name, row in recipes.SEARCHES.items():
        assert row["trials"] >= TRIALS, name
        assert {int(scene.split("-")[1]) for scene in row["scenes"]} <= set(DEVELOPMENT_VARIANTS), name
        assert f"{name}.tuned" in recipes.METHODS
