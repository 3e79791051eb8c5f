from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from toy_fits import PARTS, WORLD, images, method, silent, surfaces

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import Budget
from spike4dgs.method.fit import RecipeMethod, choose_ticks, make_training_images, measure
from spike4dgs.method.fitted_model import FittedModel
from spike4dgs.method.gaussians.density import GradientStatistics, refine
from spike4dgs.method.gaussians.parameters import from_points
from spike4dgs.method.motion.table import MOTIONS
from spike4dgs.method.observations.lookup import moving
from spike4dgs.method.schedule import choose_time, stages
from spike4dgs.method.settings import TrainSettings, make_settings
from spike4dgs.method.supervision.table import SUPERVISIONS
from spike4dgs.method.trainer import Trainer, seeded


@cache
def fitted(motion: str) -> FittedModel:
    extra = {"coarse_steps": 160} if motion == "static" else {}
    return method(motion, **extra).fit(WORLD.training, Budget(), "cpu", 0, silent)


@pytest.mark.slow
def test_a_moving_board_is_seen_from_a_new_place():
    assert WORLD.psnr(fitted("hexplane"), moving=False) > 25


@pytest.mark.slow
def test_spacetime_gaussians_beat_a_static_scene_where_things_move():
    assert WORLD.psnr(fitted("spacetime"), moving=True) > WORLD.psnr(fitted("static"), moving=True) + 2


@pytest.mark.slow
def test_deformation_beats_a_static_scene_where_things_move():
    assert WORLD.psnr(fitted("hexplane"), moving=True) > WORLD.psnr(fitted("static"), moving=True) + 2


def trainer(steps: int = 12, motion: str = "hexplane", supervision: str = "pixel", **settings: float) -> Trainer:
    scene = WORLD.training
    s = replace(
        TrainSettings(coarse_steps=steps // 3, fine_steps=steps - steps // 3, mlp_width=16, views_per_step=3),
        refine_every=2,
        time_spacing_ticks=40,
        **settings,
    )
    start = surfaces(scene, 0)
    extent = measure(start, scene)
    first = from_points(start.points[::3], start.values[::3], opacity=0.5)
    model = MOTIONS[motion](extent, s, seeded(0, -1))
    training_images = make_training_images(scene, start.cameras, images, s, "cpu")
    loss = SUPERVISIONS[supervision](s, scene)
    return Trainer(training_images, model.attach(first, training_images), model, loss, s, scale=extent.scale, seed=3)


@pytest.mark.parametrize("motion", ["paths", "hexplane"])
def test_what_never_changes_is_frozen_after_the_static_stage(motion: str) -> None:
    """Frozen Gaussians lie where the views see no change, and nothing touches them again."""
    fit = trainer(24, motion=motion, freeze_still=True)
    while fit.step < 8:
        fit.train_step()
    assert len(fit.still) == 0
    fit.train_step()
    frozen = {k: v.clone() for k, v in fit.still.tensors().items()}
    assert len(fit.still) > 50 and len(fit.gaussians) > 50
    limit = fit.settings.moving_change
    assert (
        moving(fit.still.means, fit.training_images).max()
        <= limit
        < moving(fit.gaussians.means.detach(), fit.training_images).max()
    )
    before = fit.gaussians.colors.detach().clone()
    while fit.step < 10:
        fit.train_step()
    assert not torch.equal(before, fit.gaussians.colors)
    assert all(torch.equal(v, fit.still.tensors()[k]) for k, v in frozen.items())


def test_paths_lay_nothing_down_where_the_background_is_not_drawn() -> None:
    """Guided sampling would take what is frozen for missing."""
    fit = trainer(24, motion="paths", freeze_still=True)
    while fit.step < 12:
        fit.train_step()
    assert fit.motion.guide(fit.gaussians, fit.training_images, seeded(0, 0)) is fit.gaussians
    assert (fit.gaussians.extra["times"].detach() - 0.5).abs().max() < 0.1


class Killed(Exception):
    pass


def tensors(t: Trainer) -> dict[str, torch.Tensor]:
    return {k: v.detach().clone() for k, v in t.state().tensors.items()}


PARTS_WITH_STATE = {
    "hexplane": {},
    "spacetime": {"motion": "spacetime"},  # parameters of each Gaussian, and guided sampling at steps 4 and 6
    "spike-render": {"supervision": "spike-render"},  # a loss with parameters
    "paths": {"motion": "paths", "freeze_still": True, "steps": 24},  # a background from step 8 on
}


@cache
def uninterrupted(parts: str = "hexplane") -> dict[str, torch.Tensor]:
    whole = trainer(**PARTS_WITH_STATE[parts])
    whole.run(silent)
    return tensors(whole)


@pytest.mark.parametrize(
    ("parts", "step"),
    [
        *(("hexplane", s) for s in range(1, 12)),
        *((p, s) for p in ("spacetime", "spike-render") for s in (3, 6, 9)),
        *(("paths", s) for s in (7, 8, 9, 15)),
    ],
)
def test_killed_at_any_step_and_resumed_gives_the_same_bits(parts, step, tmp_path):
    path = tmp_path / "fit.safetensors"
    first = trainer(**PARTS_WITH_STATE[parts])
    original = first.train_step

    def dies() -> torch.Tensor:
        if first.step == step:
            raise Killed
        return original()

    first.train_step = dies
    with pytest.raises(Killed):
        first.run(silent, path, "this", checkpoint_s=0)
    second = trainer(**PARTS_WITH_STATE[parts])
    second.run(silent, path, "this")
    result = tensors(second)
    assert result.keys() == uninterrupted(parts).keys()
    for name, value in uninterrupted(parts).items():
        assert torch.equal(result[name], value), name


def test_one_seed_one_result_and_another_seed_another():
    again = trainer()
    again.run(silent)
    assert all(torch.equal(v, uninterrupted()[k]) for k, v in tensors(again).items())
    other = trainer()
    other.seed = 4
    other.run(silent)
    assert not torch.equal(tensors(other)["gaussians.means"][:50], uninterrupted()["gaussians.means"][:50])


def test_refinement_changed_the_number_of_gaussians():
    assert len(uninterrupted()["gaussians.means"]) != len(trainer().gaussians)


def test_finished_fit_is_read_back_from_its_checkpoint(tmp_path):
    path = tmp_path / "fit.safetensors"
    small = method("hexplane", coarse_steps=2, fine_steps=3)
    one = small.fit(WORLD.training, Budget(), "cpu", 0, silent, path)
    two = small.fit(WORLD.training, Budget(), "cpu", 0, silent, path)
    images = [m.render(WORLD.held_out, 3000.0) for m in (one, two)]
    assert images[0].dtype == np.float32 and np.array_equal(*images) and path.is_file()


def test_checkpoint_of_another_fit_or_damaged_is_refused(tmp_path):
    path = tmp_path / "fit.safetensors"
    small = method("static", coarse_steps=1)
    small.fit(WORLD.training, Budget(), "cpu", 0, silent, path)
    with pytest.raises(UserError, match="another fit's; delete it"):
        small.fit(WORLD.training, Budget(), "cpu", 1, silent, path)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(UserError, match=r"fit.safetensors: expected a checkpoint, found damaged data"):
        small.fit(WORLD.training, Budget(), "cpu", 0, silent, path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": "none"}, "expected images among short, found 'none'"),
        ({"initialization": "colmap"}, "initialization among true"),
        ({"motion": "wobble"}, "motion among hexplane, paths, spacetime, spacetime-lite, static"),
        ({"supervision": "spikes"}, r"supervision among pixel, pixel\+spike, spike"),
    ],
)
def test_unknown_part_is_named(change, message):
    recipe = replace(method("static").recipe, **change)
    with pytest.raises(UserError, match=message):
        RecipeMethod(recipe, PARTS).fit(WORLD.training, Budget(), "cpu", 0, silent)


@pytest.mark.parametrize(("name", "value"), [("steps", 3), ("coarse_steps", 2.5), ("ramp", "slow"), ("levels", True)])
def test_unknown_setting_or_wrong_type_is_refused(name, value):
    with pytest.raises(UserError, match=name):
        make_settings({name: value}, "recipe x", TrainSettings())


def test_device_that_is_not_there_is_refused():
    with pytest.raises(UserError, match="device"):
        method("static").fit(WORLD.training, Budget(), "cuda:63", 0, silent)


def test_budget_scales_steps_only():
    s = TrainSettings()
    half = s.scaled(0.5)
    steps = ("coarse_steps", "fine_steps", "piece_steps")
    assert all(getattr(half, name) == getattr(s, name) // 2 for name in steps)
    assert replace(half, **{name: getattr(s, name) for name in steps}) == s


def test_moving_scene_opens_up_from_the_middle_to_the_whole_clip():
    s = TrainSettings(coarse_steps=200, fine_steps=400, ramp=0.5, coarse_share=0.2)
    coarse, fine = stages(s, moves=True)
    first = {choose_time(s, coarse, step, 100) for step in range(200)}
    assert min(first) >= 39 and max(first) <= 60 and len(first) > 15
    opening = [[choose_time(s, fine, step, 100) for step in range(a, a + 40)] for a in (200, 260, 330)]
    reach = [max(times) - min(times) for times in opening]
    assert reach[0] < 40 and reach[0] + 15 < reach[1] and reach[1] + 15 < reach[2]
    whole = {choose_time(s, fine, step, 100) for step in range(400, 600)}
    assert min(whole) <= 1 and max(whole) >= 98 and len(whole) > 80
    (throughout,) = stages(s, moves=True, rests_first=False)
    assert throughout.deforms and throughout.steps == 600
    (only,) = stages(s, moves=False)
    assert len({choose_time(s, only, step, 100) for step in range(200)}) > 95


@pytest.mark.parametrize("n_ticks", [1, 5, 80, 400, 10000])
def test_training_ticks_lie_inside_the_clip_and_are_bounded(n_ticks):
    ticks = choose_ticks(n_ticks, TrainSettings())
    assert 0 <= ticks[0] and ticks[-1] < n_ticks and len(ticks) <= 256 and list(ticks) == sorted(set(ticks))


def test_extent_comes_from_the_points_and_not_only_from_the_array():
    scene = WORLD.training
    start = surfaces(scene, 0)
    outlier = np.array([[1e5, 0, 0]], np.float32)
    extent = measure(replace(start, points=np.concatenate([start.points, outlier])), scene)
    assert extent.scale > 1.5  # the array's own radius is 0.57 m, the scene is 4 m away
    assert float(extent.high[0]) < 10 and (extent.low < extent.high).all()


def test_full_scene_relocates_and_open_scene_prunes_and_grows():
    s = TrainSettings()
    g = from_points(
        np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32), np.ones(20, np.float32), opacity=0.5
    )
    g.logits[:5] = -10.0
    statistics = GradientStatistics(torch.full((20,), 1.0), torch.ones(20))
    (moved,) = refine(g, statistics, s, 1.0, 15, torch.Generator())
    assert len(moved.gaussians) == 20 and (moved.gaussians.logits > -6).all()
    (grown,) = refine(g, statistics, s, 1.0, 40, torch.Generator())
    assert len(grown.gaussians) == 30 and (grown.source[:5] < 15).sum() >= 0
    (calm,) = refine(g, GradientStatistics.zero(20, g.means.device), s, 1.0, 40, torch.Generator())
    assert len(calm.gaussians) == 15 and (calm.source >= 5).all()
