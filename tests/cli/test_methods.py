"""`methods` lists what is installed."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from dummy_methods import CountMethod
from rich.console import Console

from spike4dgs.baselines.recipes import POSED, RECIPES
from spike4dgs.benchmark import UserError, plugins
from spike4dgs.benchmark.method import find_methods, get_method, with_settings
from spike4dgs.benchmark.runs.record import check_method_name
from spike4dgs.benchmark.runs.refinement import SUFFIX
from spike4dgs.cli import main, methods
from spike4dgs.method.settings import as_dict

METHODS = find_methods()


@pytest.mark.parametrize("columns", [80, 100])
def test_every_installed_method_has_one_line_that_fits_the_terminal(
    columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(methods, "make_console", lambda: Console(width=columns, highlight=False))
    assert main(["methods"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= columns and not any("\N{HORIZONTAL ELLIPSIS}" in line for line in lines)
    found = {line.split()[0]: line for line in lines[3:-1]}
    assert list(METHODS) == [name for name in found if name in METHODS]
    for recipe in (*RECIPES, *POSED):
        parts = [recipe.images, recipe.initialization, recipe.motion, recipe.supervision]
        assert found[recipe.name].split()[1:] == parts
    assert found["nearest-view"].split()[1:] == ["tfp", "-", "-", "-"]


def test_a_recipe_is_described_with_its_settings_and_their_reasons(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["methods", "spike4dgs-x"]) == 0
    text = capsys.readouterr().out
    assert METHODS["spike4dgs-x"].description in text and "given beside streams" in text
    found = {line.split()[0]: " ".join(line.split()[1:]) for line in text.splitlines() if "." in line.split()[0]}
    settings = METHODS["spike4dgs-x"].settings
    assert {f"{part}.{name}" for part, values in as_dict(settings).items() for name in values} <= set(found)
    assert found["density.prune_opacity"] == "0.005 fainter ones are removed"
    assert found["motion.lr_coefficients"].startswith("0.007 * of the polynomials")
    assert main(["methods", "spike4dgs-y"]) == 2
    assert main(["methods", "nearest-view"]) == 0


def test_descriptions_tell_methods_apart() -> None:
    texts = [method.description for method in METHODS.values()]
    assert all(texts) and len(set(texts)) == len(texts)
    assert "description" not in METHODS["tfp+4dgs"].params, "words are no part of the key that a run resumes by"


def test_other_packages_are_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    package = SimpleNamespace(name="theirs", version="2.1")
    entry = SimpleNamespace(name="a", value="a:M", dist=package, load=lambda: {"counts": CountMethod()})
    monkeypatch.setattr(plugins, "entry_points", lambda group: [entry])
    assert main(["methods"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].split() == ["theirs", "2.1"] and lines[3].split() == ["counts", "-", "-", "-", "-"]
    assert main(["methods", "counts"]) == 0
    first = "counts: Steps towards equal weights of the training views, with a checkpoint after every step."
    assert capsys.readouterr().out.splitlines()[0] == first


SET = "motion.lr_grid=0.005"


def test_a_method_with_other_settings_has_them_in_its_name_and_parameters() -> None:
    plain, changed = METHODS["tfp+4dgs"], get_method(f"tfp+4dgs[{SET},density.refine_every=50]")
    assert changed.name == f"tfp+4dgs[{SET},density.refine_every=50]" and plain.name == "tfp+4dgs"
    assert changed.params["settings"]["motion"] == plain.params["settings"]["motion"] | {"lr_grid": 0.005}
    assert changed.params["settings"]["density"]["refine_every"] == 50
    assert with_settings(plain, (SET, "density.refine_every=50")).params == changed.params
    check_method_name(changed.name)
    check_method_name(changed.name + SUFFIX)


@pytest.mark.parametrize(
    ("method", "setting", "message"),
    [
        ("tfp+4dgs", "motion.lr_grids=1", "found 'motion.lr_grids'; did you mean 'motion.lr_grid'"),
        ("tfp+4dgs", "lr_grid=1", "found 'lr_grid'; did you mean 'motion.lr_grid'"),
        ("tfp+4dgs", "motion.lr_grid", "--set: expected PART.NAME=VALUE"),
        ("tfp+4dgs", "motion.lr_grid=many", "expected motion.lr_grid as float, found 'many'"),
        ("tfp+4dgs", "motion.lr_grid=NaN", "expected motion.lr_grid as float, found 'NaN'"),
        ("tfp+4dgs", "motion.lr_grid=1e999", "expected motion.lr_grid as float, found '1e999'"),
        ("tfp+4dgs", f"trainer.fine_steps={10**29}", "expected trainer.fine_steps as int, found '1000"),
        (
            "tfp+4dgs",
            f"motion.lr_grid=0.{'0' * 90}1",
            "--set: expected settings of 100 characters at most, in one list",
        ),
        ("tfp+4dgs", "motion.lr_grid=../x", "--set: expected PART.NAME=VALUE"),
        ("nearest-view", SET, "expected a method that is made of settings, found nearest-view"),
    ],
)
def test_settings_that_a_method_does_not_have_are_refused(method: str, setting: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        with_settings(METHODS[method], (setting,))


def test_the_setting_that_help_and_errors_show_is_one_of_the_default_method(capsys) -> None:
    assert main(["fit", "--help"]) == 0
    shown = re.sub(r"[\s│]+", " ", capsys.readouterr().out)
    setting = re.search(r"such as (\S+=[\d.]+)", shown)[1]
    with pytest.raises(UserError, match=f"PART.NAME=VALUE, such as {setting}"):
        with_settings(METHODS["spike4dgs-x"], ("lr",))
    assert with_settings(METHODS["spike4dgs-x"], (setting,)).name == f"spike4dgs-x[{setting}]"


def test_settings_beside_those_of_a_name_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = f"tfp+4dgs[{SET}]"
    assert main(["fit", str(tmp_path), "--method", name, "--set", "motion.tv_weight=0.1"]) == 2
    assert "in one list, found tfp+4dgs[motion.lr_grid=0.005] with motion.tv_weight=0.1" in capsys.readouterr().err


def test_a_setting_of_the_recipes_own_value_is_refused() -> None:
    value = METHODS["tfp+4dgs"].params["settings"]["motion"]["lr_grid"]
    with pytest.raises(UserError, match="expected a setting that differs"):
        get_method(f"tfp+4dgs[motion.lr_grid={value}]")
