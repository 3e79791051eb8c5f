"""Models on disk: the same images, one clear error for anything else, and what a run writes."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch
from dummy_methods import CountMethod, run
from hard_case import HardCase
from moving_world import MovingWorld
from saved_models import DURATION_US, MODELS, WORLD, model, provenance
from small_scenes import write_small_scene

from spike4dgs.baselines.recipes import PARTS
from spike4dgs.benchmark import plugins
from spike4dgs.benchmark.errors import UserError
from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.models.fitted_model import FittedModel
from spike4dgs.method.models.model_file import ModelFile, read_model, write_model
from spike4dgs.method.models.saved_model import load_model
from spike4dgs.method.motion.table import Static
from spike4dgs.method.splat import PixelFilter

MOTIONS = PARTS.motion


class Drift(Static):
    """A motion of another package."""


FLAT = Path(__file__).parent / "flat_settings_models"  # of a version with one flat list of settings


def again(fitted: Any, path: Path) -> Any:
    """A model that was saved and loaded."""
    fitted.save(path, provenance())
    return load_model(path).model


@pytest.mark.hard_case(
    asked="save and load a model ({name}); render it before, in and after the clip", twin="the model that was saved",
    unit="of white",
)  # fmt: skip
@pytest.mark.parametrize("name", MODELS)
def test_a_loaded_model_renders_the_same_bits(name: str, tmp_path: Path, hard_case: HardCase) -> None:
    path, camera, original = tmp_path / "deep" / "m.safetensors", WORLD.held_out, model(name)
    loaded = again(original, path)
    assert type(loaded) is type(original)
    images = {t: original.render(camera, t) for t in (-10.0, 0.0, 1234.5, 0.5 * DURATION_US, DURATION_US, 1e9)}
    assert min(image.std() for image in images.values()) > 0.01, "a test of nothing"
    assert name == "static" or np.abs(images[0.0] - images[DURATION_US]).max() > 0.01, "a test of nothing"
    for t_us, image in images.items():
        hard_case.close(loaded.render(camera, t_us), image, f"{t_us:g} us")
    assert [p.name for p in path.parent.iterdir()] == ["m.safetensors"], "nothing temporary is left"


def test_models_and_motions_of_other_packages_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By entry points, as the paper's baselines are: `method` imports neither."""
    theirs = {
        "spike4dgs.models": {"gaussians": FittedModel.from_file, "ghosts": lambda file, device: (file.config, device)},
        "spike4dgs.motions": {"drift": Drift},
    }

    def entry_points(group: str) -> list[SimpleNamespace]:
        return [SimpleNamespace(name="theirs", value="theirs:M", dist=None, load=lambda: theirs[group])]

    monkeypatch.setattr(plugins, "entry_points", entry_points)
    write_model(tmp_path / "ghosts", ModelFile("ghosts", {"a": 1}, {"x": torch.ones(2)}, provenance()))
    assert load_model(tmp_path / "ghosts").model == ({"a": 1}, "cpu")
    still = model("static")
    moved = dataclasses.replace(still, spec=dataclasses.replace(still.spec, name="drift"))
    loaded = again(moved, tmp_path / "drift")
    assert isinstance(loaded, FittedModel) and isinstance(loaded.motion, Drift)


def test_a_model_keeps_the_filter_that_it_was_fitted_with(tmp_path: Path) -> None:
    wide = PixelFilter(4.0, compensated=True)
    customary, fitted = model("paths"), dataclasses.replace(model("paths"), pixel_filter=wide)
    loaded = again(fitted, tmp_path / "m")
    images = [m.render(WORLD.held_out, 0.5 * DURATION_US) for m in (loaded, fitted, customary)]
    assert loaded.pixel_filter == wide
    np.testing.assert_array_equal(images[0], images[1])
    assert abs(images[1] - images[2]).max() > 0.01, "the filter matters"


def test_light_is_not_in_what_a_network_decodes() -> None:
    steady = model("spacetime")
    lit = dataclasses.replace(steady, light=torch.tensor([0.5, 1.5]))
    assert torch.equal(lit.splats(0.0).colors, steady.splats(0.0).colors) and steady.splats(0.0).colors.shape[1] > 1
    image = lit.render(WORLD.held_out, 0.0)
    np.testing.assert_allclose(image, 0.5 * steady.render(WORLD.held_out, 0.0), rtol=1e-5)


@pytest.mark.parametrize("name", ["paths", "tracking"])
def test_a_model_keeps_the_light_that_it_was_fitted_in(name: str, tmp_path: Path) -> None:
    steady, factors = model(name), torch.tensor([0.5, 1.0, 1.5, 1.0])
    lit = dataclasses.replace(steady, light=factors)
    loaded = again(lit, tmp_path / "m")
    # The middles of four parts of the clip are at 1/8, 3/8, ...; linear between, constant beyond.
    for share, factor in ((0.0, 0.5), (0.125, 0.5), (0.25, 0.75), (0.625, 1.5), (1.0, 1.0)):
        image = loaded.render(WORLD.held_out, share * DURATION_US)
        np.testing.assert_array_equal(image, lit.render(WORLD.held_out, share * DURATION_US))
        np.testing.assert_allclose(image, factor * steady.render(WORLD.held_out, share * DURATION_US), rtol=1e-5)
        colors = [m.splats(share * DURATION_US).colors for m in (loaded, steady)]
        torch.testing.assert_close(colors[0], factor * colors[1]), "as files of splats have it"


def test_a_model_keeps_the_layer_of_a_lamp(tmp_path: Path) -> None:
    """A layer of all light is light of one factor."""
    steady, factors = model("paths"), torch.tensor([0.5, 1.0, 1.5, 1.0])

    def layered(g: Gaussians) -> Gaussians:
        return dataclasses.replace(g, colors=g.colors.repeat(1, 2))

    both = {"pieces": tuple(map(layered, steady.pieces)), "background": layered(steady.background)}
    lit, whole = dataclasses.replace(steady, light=factors, **both), dataclasses.replace(steady, light=factors)
    loaded = again(lit, tmp_path / "m")
    for share in (0.0, 0.25, 0.6):
        image = loaded.render(WORLD.held_out, share * DURATION_US)
        np.testing.assert_array_equal(image, lit.render(WORLD.held_out, share * DURATION_US))
        np.testing.assert_allclose(image, whole.render(WORLD.held_out, share * DURATION_US), rtol=1e-5, atol=1e-6)


def test_a_model_keeps_the_path_of_the_array_and_renders_along_it(tmp_path: Path) -> None:
    still, path = model("paths"), MovingWorld().path
    fitted = dataclasses.replace(still, path=path)
    loaded = again(fitted, tmp_path / "m")
    for share in (0.0, 0.5, 1.0, 1.0):
        image = loaded.render(WORLD.held_out, share * DURATION_US)
        np.testing.assert_array_equal(image, fitted.render(WORLD.held_out, share * DURATION_US))
        posed = still.render(path.posed([WORLD.held_out], share)[0], share * DURATION_US)
        assert abs(image - posed).max() < 1e-3


@pytest.mark.parametrize("factors", [[[1.0]], [], [1.0, float("nan")], [-1.0]])
def test_a_light_that_is_none_is_refused(factors: Any, tmp_path: Path) -> None:
    dataclasses.replace(model("paths"), light=torch.tensor(factors)).save(tmp_path / "m", provenance())
    with pytest.raises(UserError, match="factors of the light"):
        load_model(tmp_path / "m")


@pytest.mark.parametrize("name", ["hexplane", "paths", "spacetime"])
def test_a_model_of_the_version_with_flat_settings_renders_as_then(name: str, tmp_path: Path) -> None:
    """The same tensors by the same names, other settings; to the bit here, and elsewhere within the processor's."""
    loaded = load_model(FLAT / f"{name}.safetensors")
    frames = np.load(FLAT / "frames.npz")
    loaded.model.save(tmp_path / "m", loaded.provenance)
    again = load_model(tmp_path / "m").model
    for share in (0.1, 0.9):
        image = loaded.model.render(WORLD.held_out, share * DURATION_US)
        np.testing.assert_allclose(image, frames[f"{name}_{share}"], rtol=0, atol=1e-5)
        np.testing.assert_array_equal(again.render(WORLD.held_out, share * DURATION_US), image)
    old, new = (safetensors.torch.load_file(p) for p in (FLAT / f"{name}.safetensors", tmp_path / "m"))
    assert old.keys() == new.keys() and all(torch.equal(v, new[k]) for k, v in old.items())
    settings = read_model(tmp_path / "m").config["motion"]["settings"]
    own = {"features": 4, "mlp_width": 8, "cell_ticks": 16.0} if name == "hexplane" else {}
    assert settings == dataclasses.asdict(MOTIONS[name].defaults) | own


def test_where_it_comes_from_is_kept(tmp_path: Path) -> None:
    model("static").save(tmp_path / "m", provenance(fit_seconds=12.25, budget="paper"))
    found = load_model(tmp_path / "m")
    expected = provenance(fit_seconds=12.25, budget="paper")
    assert found.title == "toy+4dgs on toy" and found.provenance.duration_us == DURATION_US
    same = {k: v for k, v in vars(expected).items() if k != "cameras"}
    assert {k: v for k, v in vars(found.provenance).items() if k != "cameras"} == same
    for a, b in zip(found.provenance.cameras, WORLD.cameras, strict=True):
        assert (a.id, a.width, a.height, a.K.tolist()) == (b.id, b.width, b.height, b.K.tolist())
        np.testing.assert_allclose(a.w2c, b.w2c, atol=1e-12)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "m.safetensors"
    model("hexplane").save(path, provenance())
    return path


def refused(path: Path, message: str, device: str = "cpu") -> None:
    with pytest.raises(UserError, match=message) as found:
        load_model(path, device)
    assert "\n" not in str(found.value)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.999])
def test_a_file_that_was_cut_off_is_refused(saved: Path, share: float) -> None:
    data = saved.read_bytes()
    saved.write_bytes(data[: int(share * len(data))])
    refused(saved, r"m\.safetensors: expected a fitted model, found damaged data .*run-benchmark")


def test_a_tensor_of_a_type_that_numpy_lacks_is_refused(tmp_path: Path) -> None:
    metadata = {"schema": "spike4dgs-model/1", "about": "{}", "sha256": "0" * 64}
    path = tmp_path / "m.safetensors"
    safetensors.torch.save_file({"a.b": torch.zeros(3, dtype=torch.bfloat16)}, path, metadata=metadata)
    refused(path, "expected the SHA-256 that it was written with, found damaged data")


def test_what_is_no_model_is_refused(saved: Path, tmp_path: Path) -> None:
    refused(tmp_path / "none", "none: expected a fitted model, found no such file; run-benchmark writes OUT/models")
    refused(tmp_path, r"expected a model's file, found a folder \(models in it: m.safetensors\); name one file")
    refused(saved, "device: expected cpu, or a CUDA device", "nonsense")
    safetensors.torch.save_file({"x": torch.zeros(2)}, saved, metadata={"schema": "somebody/2"})
    refused(saved, "expected schema spike4dgs-model/1, found 'somebody/2'")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: {"kind": "ghosts"}, "expected a model of kind gaussians, .* found 'ghosts'"),
        (lambda f: {"config": {}}, "cannot read .KeyError"),
        (lambda f: {"config": {"motion": {**f.config["motion"], "name": "warp"}}}, "cannot read .KeyError: 'warp'"),
        (lambda f: {"config": {"motion": {**f.config["motion"], "settings": {"x": 1}}}}, "found 'x'; correct the name"),
        (
            lambda f: {"config": {"motion": {**f.config["motion"], "settings": {"features": 5}}}},
            "cannot read .ValueError: .* in place of",
        ),
        (lambda f: {"config": {**f.config, "filter": {"variance": -1.0}}}, "ValueError: -1.0 is no number"),
        (lambda f: {"config": {**f.config, "filter": {"compensated": 1}}}, "cannot read .ValueError: a filter with"),
        (lambda f: {"config": {**f.config, "filter": {"sigma": 1.0}}}, "cannot read .TypeError"),
        (lambda f: {"tensors": {k: v for k, v in f.tensors.items() if k != "piece0.means"}}, "cannot read .KeyError"),
        (lambda f: {"provenance": provenance(cameras=())}, "at cameras"),
        (lambda f: {"provenance": provenance(rate_hz=0.0)}, "at rate_hz"),
        (lambda f: {"provenance": provenance(method={})}, "at method: 'name' is a required property"),
    ],
)
def test_a_model_of_another_version_is_one_clear_error(saved: Path, change: Any, message: str) -> None:
    file = read_model(saved)
    write_model(saved, dataclasses.replace(file, **change(file)))
    refused(saved, message)


@pytest.mark.parametrize(("name", "columns"), [("paths", 8), ("paths", 1), ("times", 1), ("spins", 3)])
def test_paths_of_another_shape_are_refused(name: str, columns: int, tmp_path: Path) -> None:
    """The kernels take the shapes for granted, and would read what lies behind the tensors."""
    path = tmp_path / "m.safetensors"
    model("paths").save(path, provenance())
    file, key = read_model(path), f"piece0.{name}"
    rows = len(file.tensors[key])
    other = file.tensors[key].reshape(rows, -1)[:, :1].expand(rows, columns).contiguous()
    write_model(path, dataclasses.replace(file, tensors={**file.tensors, key: other}))
    refused(path, rf"cannot read .ValueError: \w+ of \d+ Gaussians is \(\d+, {columns}\)")


class Kept(CountMethod):
    """Its models can be saved."""

    def fit(self, *args: Any, **kwargs: Any) -> Any:
        """A toy model that renders what the method's own renders."""
        fitted, toy = super().fit(*args, **kwargs), model("hexplane")
        fitted.save = toy.save
        return fitted


def test_a_run_keeps_the_models_that_can_be_saved(tmp_path: Path) -> None:
    scene = write_small_scene(tmp_path / "scene")
    run(tmp_path / "out", [scene], Kept("kept"), CountMethod("fleeting"))
    assert [*(tmp_path / "out/models").rglob("*.*")] == [tmp_path / "out/models/kept/pattern-0.safetensors"]
    found = load_model(tmp_path / "out/models/kept/pattern-0.safetensors").provenance
    about = json.loads((tmp_path / "out/predictions/kept/pattern-0/prediction.json").read_text())
    assert found.method == about["method"] and found.scene_revision == about["scene_revision"]
    assert (found.scene, found.split, found.budget) == ("pattern-0", about["split"], about["budget"])
    assert [c.id for c in found.cameras] == ["cam_00", "cam_01", "cam_02"]
    assert (found.n_ticks, found.rate_hz, found.radiance_gain) == (80, 20000.0, 0.6)
    assert found.harness == about["harness"]
