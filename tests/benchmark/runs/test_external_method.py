"""A method of another package is found, fitted, scored and ranked; another program's images are scored and ranked."""

import ast
import functools
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from packages import install
from skimage.metrics import peak_signal_noise_ratio
from toy_world import ToyWorld

from spike4dgs.benchmark import Scene, UserError, open_scene
from spike4dgs.benchmark.method import FitRequest, check_protocol, find_methods, get_method
from spike4dgs.benchmark.scene.images import read_exr
from spike4dgs.cli import main

METHODS = find_methods()

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of the installed example package, which is on the path."""
    root = tmp_path_factory.mktemp("external")
    source, target = shutil.copytree(EXAMPLES / "external_method", root / "source"), root / "site"
    install(source, target)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(target))
        yield target
    sys.modules.pop("plane_blend", None)


@pytest.fixture(scope="module")
def scene(one_small_scene: Path) -> Scene:
    return open_scene(one_small_scene)


@pytest.fixture(scope="module")
def predictions(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The images that the script makes, with warnings as errors."""
    out, script = tmp_path_factory.mktemp("predictions") / "images", EXAMPLES / "predictions_only.py"
    subprocess.run([sys.executable, "-W", "error", str(script), str(scene.root), str(out)], check=True)
    return out


def board(folder: Path) -> dict[str, dict[str, Any]]:
    """Rows of the only board, by method."""
    (contest,) = json.loads((folder / "local.json").read_text())["boards"]
    return {row["method"]: row for row in contest["rows"]}


def test_the_method_is_found_through_its_entry_point(installed: Path) -> None:
    methods = find_methods()
    assert methods["plane-blend"].name == "plane-blend"
    assert Path(sys.modules["plane_blend"].__file__ or "").parent == installed
    assert set(METHODS) <= set(methods), "beside those of this distribution"


@pytest.mark.usefixtures("no_images")
def test_it_is_fitted_scored_and_ranked_beside_others(installed: Path, scene: Scene, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for name, *options in (("nearest-view", "--in-process"), ("plane-blend",)):  # the other in a process of its own
        assert main(["run-benchmark", str(scene.root), "--methods", name, "--out", str(out), *options]) == 0
    record = json.loads((out / "results/plane-blend.json").read_text())
    assert record["method"]["params"] == {"planes": 24, "half_window_ticks": 20}
    assert record["method"]["version"] == "0.1.0"
    assert record["scenes"][scene.id]["status"] == "ok"
    assert set(record["scenes"][scene.id]["per_image"]) == {t.name for t in scene.targets}
    rows = board(out / "leaderboard")
    assert sorted(row["rank"] for row in rows.values()) == [1, 2]
    assert all(row["label"] == "re-scored" for row in rows.values())
    better, worse = sorted(rows.values(), key=lambda row: row["rank"])
    assert better["mean"]["psnr"] >= worse["mean"]["psnr"]


def test_the_example_reconstructs_something(installed: Path) -> None:
    """With large parallax, two images warped onto the best plane beat the nearest camera's image."""
    world = ToyWorld()
    values = {}
    for name in ("plane-blend", "nearest-view"):
        model = find_methods()[name].fit(world.training, FitRequest())
        image = model.render(world.held_out, 120 * 50.0)
        truth = world.trace(world.held_out, 0.5)[0]
        values[name] = peak_signal_noise_ratio(truth, np.clip(image, 0, 1).astype(np.float64), data_range=1)
    assert values["plane-blend"] > values["nearest-view"] + 1, values


def test_the_warp_follows_the_cameras(installed: Path) -> None:
    """A bright point on the plane is where the target camera sees it, to a tenth of a pixel."""
    import plane_blend

    world = ToyWorld()
    source, target = world.cameras[0], world.held_out
    point = target.unproject(np.array([[40.3, 22.8]]), np.array([3.1]))
    at = source.project(point)[0][0]
    y, x = np.mgrid[: source.height, : source.width] + 0.5
    blob = np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 8).astype(np.float32)
    seen = plane_blend.warp(blob, source, target, 3.1).astype(np.float64)
    centre = [(seen * axis).sum() / seen.sum() for axis in (x, y)]
    np.testing.assert_allclose(centre, [40.3, 22.8], atol=0.1)


def test_images_of_another_program_are_scored_and_ranked(scene: Scene, predictions: Path, tmp_path: Path) -> None:
    result, folder = tmp_path / "result.json", tmp_path / "board"
    assert main(["score", str(predictions), str(scene.root), "--out", str(result)]) == 0
    files = ["--predictions", str(predictions), "--scenes", str(scene.root)]
    assert main(["submit", str(result), *files, "--leaderboard", str(folder)]) == 0
    row = board(folder)["mean-of-cameras"]
    assert row["rank"] == 1 and row["label"] == "re-scored" and row["mean"]["psnr"] > 5


def test_the_program_reads_streams_as_the_benchmark_does(scene: Scene, predictions: Path) -> None:
    for target in scene.targets:
        window = (max(0, target.tick - 20), min(scene.n_ticks, target.tick + 20))
        counts = [scene.stream(camera).counts(*window) for camera in scene.train]
        expected = np.mean(counts, axis=0) / (window[1] - window[0]) / scene.radiance_gain
        np.testing.assert_allclose(read_exr(predictions / f"{target.name}.exr"), expected, rtol=1e-3)


@pytest.fixture
def outdated(installed: Path, tmp_path: Path) -> Iterator[Path]:
    """The installed example package as it was written against the earlier protocol."""
    target = Path(shutil.copytree(installed, tmp_path / "site", ignore=shutil.ignore_patterns("__pycache__")))
    module = target / "plane_blend.py"
    text = module.read_text()
    earlier = text.replace("(self, scene, request)", "(self, scene, budget, device, seed, progress, checkpoint=None)")
    module.write_text(earlier.replace("request.progress(", "progress("))
    assert module.read_text() != text
    loaded = sys.modules.pop("plane_blend", None)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(target))
        yield target
    sys.modules.pop("plane_blend", None)
    if loaded:
        sys.modules["plane_blend"] = loaded


def test_a_package_of_the_earlier_protocol_is_one_error_that_says_what_to_change(
    outdated: Path, scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(UserError) as found:
        get_method("plane-blend")
    where, said = "spike4dgs-plane-blend 0.1.0, entry point plane-blend = plane_blend:METHODS", str(found.value)
    assert said.startswith(f"method 'plane-blend' of {where}: expected fit(self, scene, request), found the earlier ")
    assert "fit(scene, budget, device, seed, progress, checkpoint=None); take a FitRequest" in said
    assert main(["run-benchmark", str(scene.root), "--methods", "plane-blend", "--out", str(tmp_path / "out")]) != 0
    assert capsys.readouterr().err.count("the earlier protocol") == 1


class Takes:
    """A method whose `fit` is given."""

    name = "takes"

    def __init__(self, fit: Any) -> None:
        self.fit = fit


def test_other_callables_than_plain_methods_pass() -> None:
    def earlier(scene: Any, budget: Any, device: str, seed: int, progress: Any) -> None: ...

    @functools.wraps(earlier)
    def adapted(*args: Any, **kwargs: Any) -> None: ...

    passing = (
        lambda scene, request: None,
        lambda scene, request, more=1: None,
        lambda *args: None,
        lambda scene, *rest, **kwargs: None,
        functools.partial(lambda extra, scene, request: None, 1),
        adapted,
        max,  # compiled, without a signature
    )
    for fit in passing:
        check_protocol(Takes(fit), "here")
    for fit in (earlier, lambda scene: None, lambda request, *, scene: None, None):
        with pytest.raises(UserError, match=r"method 'takes' of here: expected fit\(self, scene, request\), found "):
            check_protocol(Takes(fit), "here")


@pytest.mark.parametrize("name", ["predictions_only.py", "external_method/plane_blend.py"])
def test_the_examples_import_nothing_of_this_project(name: str) -> None:
    tree = ast.parse((EXAMPLES / name).read_text())
    found = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    found |= {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    others = {module.split(".")[0] for module in found} - set(sys.stdlib_module_names)
    assert others <= {"numpy", "OpenEXR", "cv2"}
