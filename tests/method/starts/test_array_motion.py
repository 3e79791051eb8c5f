"""The path of an array from its clip: right where it moves, none where it stands, and what it is worth to a fit."""

import io
from contextlib import redirect_stderr
from dataclasses import replace

import numpy as np
import pytest
from moving_world import MovingWorld
from toy_fits import MOTIONS, SUPERVISIONS, images, request
from toy_world import ToyWorld, few_views

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import Recipe
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.fit import Parts, RecipeMethod
from spike4dgs.method.recipes import METHODS
from spike4dgs.method.starts.array_motion import Explained, _sampled
from spike4dgs.method.starts.base import Initialization, Start
from spike4dgs.method.starts.rig import RigSettings, rig

WORLD = MovingWorld(width=96, height=60, n_ticks=240, travel=0.25, seed=1)
FOLLOWS = RigSettings(follow_array=True)


@pytest.fixture(scope="module")
def said() -> io.StringIO:
    """What a start says, once there is one."""
    return io.StringIO()


@pytest.fixture(scope="module")
def scene() -> TrainingScene:
    """Four views beside the middle one."""
    return few_views(WORLD.training, 1, 3, 4, 6)


@pytest.fixture(scope="module")
def start(scene: TrainingScene, said: io.StringIO) -> Start:
    with redirect_stderr(said):
        return rig(scene, FOLLOWS)


def test_the_path_is_found_to_a_fraction_of_a_pixel(start):
    assert start.path
    camera, uv = WORLD.cameras[4], np.array([[10.0, 10], [85, 10], [10, 50], [85, 50], [48, 20]])
    points = camera.unproject(uv, np.array([3.8, 3.8, 3.2, 3.2, 3.8]))
    world = points - start.path.to_array(start.path.time)[:3, 3]
    for t in (0.0, 0.25, 0.75, 1.0):
        there = WORLD.path.to_array(t) @ np.linalg.inv(WORLD.path.to_array(start.path.time))
        expected, _ = camera.project(world @ there[:3, :3].T + there[:3, 3])
        found, _ = start.path.posed([camera], t)[0].project(world)
        assert np.abs(found - expected).max() < 0.15
        assert np.linalg.norm(expected - uv, axis=1).mean() > 0.5


def test_it_is_said_in_one_line(start, said):
    text = said.getvalue()
    assert text.startswith(f"{WORLD.training.id}: the array moves, the image by ") and text.count("\n") == 1


def test_a_view_on_whose_depths_no_other_agrees_has_no_say(scene):
    image = np.random.default_rng(0).random((8, 9, 3)).astype(np.float32)
    assert _sampled(image, np.empty((0, 2))).shape == (0, 3)
    dark = replace(scene.streams[3], packed=np.zeros_like(scene.streams[3].packed))
    found = rig(replace(scene, streams=(*scene.streams[:3], dark)), FOLLOWS)
    assert np.isfinite(found.points).all() and len(found.points) > 100


def test_an_array_that_stands_still_has_no_path_and_the_same_start(capsys):
    """Although a large board flies past."""
    still = ToyWorld(width=96, height=60, n_ticks=240, travel=1.2, seed=1, views=(0, 2, 6)).training
    found, plain = rig(still, FOLLOWS), rig(still, RigSettings())
    assert found.path is None and not capsys.readouterr().err
    assert np.array_equal(found.points, plain.points) and np.array_equal(found.values, plain.values)


@pytest.mark.parametrize(
    ("share", "motion_px", "believed"),
    [
        (0.85, 2.58, True),  # turntable-10, array that moves
        (0.80, 0.53, False),  # bricks-10, 50 ms: the array stands still, and what flies feigns a path
        (0.63, 1.95, False),  # bricks-0: so does what falls together
    ],
)
def test_what_is_believed(share, motion_px, believed):
    assert Explained(WORLD.path, share, motion_px).believed == believed


def test_a_fit_along_the_path_is_sharp_where_a_fit_of_a_still_array_is_not():
    psnr = {}
    for name, path in (("path", WORLD.path), ("still", None)):
        made = Initialization(
            lambda r, path=path: Start(r.scene.cameras, *WORLD.surfaces(r.scene.cameras[::2], 0.01), path=path)
        )
        parts = Parts({"short": images}, {"true": made}, MOTIONS, SUPERVISIONS)
        # Without a background nothing sets off at its velocity, which would follow the array too.
        steps = {"trainer.coarse_steps": 25, "trainer.fine_steps": 55}
        recipe = Recipe("test", "short", "true", "paths", "pixel", steps)
        model = RecipeMethod(recipe, parts).fit(WORLD.training, request())
        psnr[name] = WORLD.psnr(model, moving=False)
    assert psnr["path"] > psnr["still"] + 2


def test_only_the_trainer_follows_an_array():
    assert METHODS["spike4dgs-x"].params["settings"]["initialization"]["follow_array"]
    loop = replace(METHODS["spike4dgs-x"].algorithm, rasterizes=True)
    parts = replace(METHODS["spike4dgs-x"].parts, algorithms={"own": loop})
    recipe = Recipe("mine", "intervals", "rig", "own", "pixel", {"initialization.follow_array": True})
    with pytest.raises(UserError, match="mine: expected a motion of the trainer"):
        RecipeMethod(recipe, parts)
