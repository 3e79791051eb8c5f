"""Methods of installed packages, found by entry point."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from dummy_methods import CountMethod, run

from spike4dgs.benchmark import UserError, open_scene, plugins
from spike4dgs.benchmark import method as recipes
from spike4dgs.benchmark.errors import unknown
from spike4dgs.benchmark.method import GIVEN
from spike4dgs.benchmark.runs.cell import Job
from spike4dgs.benchmark.runs.predictions import read_info


def register(monkeypatch: pytest.MonkeyPatch, *names: str, load: Callable[[], dict[str, CountMethod]]) -> None:
    entries = [SimpleNamespace(name=n, value=f"{n}.recipes:METHODS", dist=None, load=load) for n in names]
    monkeypatch.setattr(plugins, "entry_points", lambda group: entries)


def test_a_package_that_cannot_be_imported_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def load() -> dict[str, CountMethod]:
        raise ImportError("no libfoo")

    register(monkeypatch, "theirs", load=load)
    with pytest.raises(UserError, match="entry point theirs: expected theirs.recipes:METHODS, found ImportError"):
        recipes.find_methods()


def test_one_name_in_two_packages_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    register(monkeypatch, "a", "b", load=lambda: {"same": CountMethod("same")})
    with pytest.raises(UserError, match="entry point b: expected a new method name, found 'same' twice"):
        recipes.find_methods()


class Unflat(CountMethod):
    given = ("poses",)


def test_calibration_recordings_are_handed_to_those_who_say_that_they_are_given_them(small_scene: Path) -> None:
    training = open_scene(small_scene).training
    recordings = tuple(object() for _ in training.cameras)
    scene = replace(training, recordings=recordings)  # type: ignore[arg-type]
    assert recipes.training_for(CountMethod(), scene).recordings is recordings
    assert recipes.training_for(Unflat(), scene).recordings == (None,) * len(training.cameras)
    assert recipes.training_for(Unflat(), scene).cameras == training.cameras


@pytest.mark.parametrize(
    ("given", "kept"), [(None, set()), (("poses", "frames"), {"frames"}), (GIVEN, {"frames", "events"})]
)
def test_frames_and_events_are_handed_to_those_who_say_that_they_are_given_them(
    small_scene: Path, given: tuple[str, ...] | None, kept: set[str]
) -> None:
    training = open_scene(small_scene).training
    scene = replace(training, found_frames={"a": object()}, found_events={"a": object()})  # type: ignore[dict-item]
    method = CountMethod()
    if given is not None:
        method.given = given  # type: ignore[attr-defined]
    handed = recipes.training_for(method, scene)
    assert {kind for kind in ("frames", "events") if getattr(handed, f"found_{kind}")} == kept


def test_what_a_method_is_given_is_recorded_and_no_part_of_the_key(small_scene: Path, tmp_path: Path) -> None:
    scene = open_scene(small_scene)
    method = CountMethod()  # of the same class: a key covers the code of other packages' methods
    method.given = ("poses",)  # type: ignore[attr-defined]
    plain, unflat = (Job(m, scene, 0, "cpu", recipes.Budget()) for m in (CountMethod(), method))
    assert "given" not in plain.info.as_dict() and unflat.info.as_dict()["given"] == ["poses"]
    assert plain.key == unflat.key, "finished predictions stay valid"
    (record,) = run(tmp_path, [small_scene], Unflat())
    assert record["method"]["given"] == ["poses"]
    assert read_info(tmp_path / "predictions/counts/pattern-0").method.given == ("poses",)


def test_a_mistyped_name_gets_the_nearest_and_no_long_list() -> None:
    known = {f"method-{k}": CountMethod() for k in range(40)}
    with pytest.raises(UserError) as error:
        recipes.get_method("metohd-7", known, "--method")
    text = str(error.value)
    assert text.startswith("--method: expected a name that `spike4dgs methods` lists, such as method-7, ")
    assert text.endswith("found 'metohd-7'; did you mean 'method-7'?") and len(text) < 160
    with pytest.raises(UserError, match="--methods: expected one of a, b, found 'xyz'; correct the name"):
        recipes.get_method("xyz", {"b": CountMethod(), "a": CountMethod()})


def test_the_part_that_all_settings_share_makes_none_of_them_nearer() -> None:
    with pytest.raises(UserError, match="found 'motion.focal'; correct the name"):
        raise unknown("here", "motion.focal", ["motion.lr_grid", "motion.cell_px"])
    with pytest.raises(UserError, match=r"did you mean 'motion.lr_grid'\?"):
        raise unknown("here", "motion.lr_gird", ["motion.lr_grid", "motion.cell_px"])
