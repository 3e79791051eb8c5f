import gc
import threading
import weakref
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from hard_case import BYTES, HardCase
from toy_fits import MOTIONS, SMALL_PLANES, WORLD, checkpoints, method, request, silent, surfaces, trainer

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import Budget, get_method
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.gaussians.density import DensitySettings
from spike4dgs.method.images.training import ImageSettings, choose_ticks
from spike4dgs.method.schedule import Stage, TrainerSettings, choose_time, stages
from spike4dgs.method.settings import as_dict, in_budget, make_settings, override
from spike4dgs.method.splat import render
from spike4dgs.method.starts.base import Start, measure
from spike4dgs.method.supervision.spike import SpikeSettings
from spike4dgs.method.torch_state import seeded
from spike4dgs.method.trainer import Trainer
from spike4dgs.method.training_views.instants import Corrections, correction, node
from spike4dgs.method.training_views.points import variation_at
from spike4dgs.method.training_views.training_images import Spans, TrainingImages


def test_a_moving_board_is_seen_from_a_new_viewpoint_better_than_by_a_static_scene():
    """By STG; 4DGS is in `test_fit`."""
    steps = {
        "spacetime": {"trainer.coarse_steps": 30, "trainer.fine_steps": 60},
        "static": {"trainer.coarse_steps": 40},
    }
    moving, static = (method(motion, extra).fit(WORLD.training, request()) for motion, extra in steps.items())
    assert WORLD.psnr(moving, moving=True) > WORLD.psnr(static, moving=True) + 2


@pytest.mark.parametrize("motion", ["paths", "hexplane"])
def test_what_never_changes_is_frozen_after_the_static_stage(motion: str) -> None:
    """Frozen Gaussians lie where the views see no change, and nothing touches them again."""
    fit = trainer(24, motion=motion, freeze_background=True)
    while fit.step < 8:
        fit.train_step()
    assert len(fit.background) == 0
    fit.train_step()
    frozen = {k: v.clone() for k, v in fit.background.tensors().items()}
    assert len(fit.background) > 50 and len(fit.gaussians) > 50
    limit = fit.settings.moving_change
    assert (
        variation_at(fit.background.means, fit.training_images).max()
        <= limit
        < variation_at(fit.gaussians.means.detach(), fit.training_images).max()
    )
    before = fit.gaussians.colors.detach().clone()
    while fit.step < 10:
        fit.train_step()
    assert not torch.equal(before, fit.gaussians.colors)
    assert all(torch.equal(v, fit.background.tensors()[k]) for k, v in frozen.items())


def test_paths_lay_nothing_down_where_the_background_is_not_rendered() -> None:
    """Guided sampling would take what is frozen for missing."""
    fit = trainer(24, motion="paths", freeze_background=True)
    while fit.step < 12:
        fit.train_step()
    assert fit.motion.guided_samples(fit.gaussians, fit.training_images, seeded(0, 0)) is fit.gaussians
    assert (fit.gaussians.extra["times"].detach() - 0.5).abs().max() < 0.1


def wide_spans(images: TrainingImages) -> Spans:
    """Spans of 160 ticks, in which the board moves by pixels; another length at each pixel."""
    times, views, height, width = images.images.shape
    lengths = 60 + 40 * torch.rand(times, views, height, width, generator=seeded(5, 0))
    return Spans(torch.stack([-lengths, lengths], 2).half(), 80.0, images.n_ticks)


def test_means_over_time_are_corrected_by_snapshots_of_the_stage() -> None:
    """From 30 % of the deforming stage on the fit compares with instants; the static stage with what was measured."""
    fit, seen = trainer(24, motion="paths", spans=wide_spans), []
    loss = fit.supervision.forward
    fit.supervision.forward = lambda render, sample: (seen.append(sample), loss(render, sample))[1]
    while fit.step < fit.total:
        fit.train_step()
    first = fit.plan[1].first + fit.plan[1].renewals[0]
    for sample in seen:
        measured = fit.training_images.measured(fit.training_images.ticks.index(sample.tick))[list(sample.views)]
        assert torch.equal(sample.images, measured) == (sample.step < first), sample.step
    tick, views = seen[-1].tick, seen[-1].views
    index = fit.training_images.ticks.index(tick)
    assert fit.corrections is not None and fit.snapshot is not None
    spans, far = fit.training_images.spans.at(index).at(torch.tensor(views)), node(80.0)

    def light(ticks: float) -> torch.Tensor:
        splats = fit.motion.splats(fit.snapshot, (tick + ticks) / fit.training_images.n_ticks)
        return render(splats, fit.training_images.views.some(views)).image[..., 0]

    expected = correction(light(-far), light(0.0), light(far), spans)
    torch.testing.assert_close(fit.corrections.at(index, views), expected, atol=1e-3, rtol=0)
    assert expected.abs().max() > 0.01, "things move"


def test_corrections_made_ahead_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    def fit() -> Trainer:
        made = trainer(24, motion="paths", spans=wide_spans)
        made.run(silent)
        assert not any(t.name == "corrections" for t in threading.enumerate()), "nothing works on after a fit"
        return made

    ahead = fit()
    monkeypatch.setattr(Corrections, "begin", lambda *_: None)
    alone = fit()
    for name, leaf in ahead.gaussians.tensors().items():
        assert torch.equal(leaf, alone.gaussians.tensors()[name]), name
    assert ahead.corrections._made.keys() == alone.corrections._made.keys(), "what no step asks for is not made"


def test_a_fit_is_freed_at_its_end() -> None:
    """Without the garbage collector, which may not come round for many fits."""
    uninterrupted("spans")  # what the first of a process loads keeps some of it
    gc.collect()
    gc.disable()
    try:
        fit = trainer(24, motion="paths", spans=wide_spans)
        fit.run(silent)
        freed = weakref.ref(fit)
        del fit
        assert freed() is None
    finally:
        gc.enable()


def test_a_fit_that_is_interrupted_leaves_nothing_working() -> None:
    fit = trainer(24, motion="paths", spans=wide_spans)

    def interrupt(done: int, total: int, note: str) -> None:
        if fit.corrections:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit.run(interrupt)
    assert not any(t.name == "corrections" for t in threading.enumerate())


def test_a_motion_with_a_network_corrects_nothing() -> None:
    fit = trainer(12, motion="hexplane", spans=wide_spans)
    fit.run(silent)
    assert fit.corrections is None


def test_a_stage_ends_with_the_mean_of_its_last_steps() -> None:
    fit, values = trainer(30, motion="paths", average=0.25), []
    average = fit._average

    def recorded(stage: Stage) -> None:
        values.append(fit.gaussians.means.detach().clone())
        average(stage)

    fit._average = recorded
    while fit.step < fit.total:
        fit.train_step()
    assert round(0.25 * fit.plan[1].steps) == 5
    torch.testing.assert_close(fit.gaussians.means.detach(), torch.stack(values[-5:]).mean(0), atol=1e-6, rtol=0)
    assert not torch.equal(fit.gaussians.means.detach(), values[-1])


def test_nothing_is_averaged_before_the_number_of_gaussians_is_settled() -> None:
    with pytest.raises(UserError, match=r"trainer.average of at most 0.4, as density.refine_stop is 0.6"):
        trainer(average=0.5)
    for stop, average in ((0.8, 0.2), (0.9, 0.1)):  # 1 - 0.8 is less than 0.2 in floating point
        trainer(average=average, density=DensitySettings(refine_stop=stop))


def tensors(t: Trainer) -> dict[str, torch.Tensor]:
    return {k: v.detach().clone() for k, v in t.state().tensors.items()}


PARTS_WITH_STATE = {
    "hexplane": {},
    "spacetime": {"motion": "spacetime"},  # parameters of each Gaussian, and guided sampling at steps 4 and 6
    "spike-render": {"supervision": "spike-render"},  # a loss with parameters
    "fixed-pattern": {"supervision": "fixed-pattern", "loss": {"first": 2, "every": 2}},  # a loss with a memory
    "paths": {"motion": "paths", "freeze_background": True, "steps": 24},  # a background from step 8 on
    "poses": {"refine_poses": True},
    "average": {"motion": "hexplane", "average": 0.3},  # from steps 3 and 10 on, networks too
    "spans": {"motion": "paths", "freeze_background": True, "steps": 24, "spans": wide_spans},  # corrected from 13 on
}


@cache
def uninterrupted(parts: str = "hexplane") -> tuple[dict[str, torch.Tensor], dict[int, bytes]]:
    """What a fit ends with, and its checkpoints."""
    whole = trainer(**PARTS_WITH_STATE[parts])
    saved = checkpoints(whole)
    return tensors(whole), saved


def bits(t: dict[str, torch.Tensor]) -> bytes:
    return b"".join(t[name].contiguous().numpy().tobytes() for name in sorted(t))


@pytest.mark.hard_case(
    asked="a fit ({parts}) interrupted at step {step} and resumed", twin="the fit that never stopped", **BYTES,
    kind="resume",
)  # fmt: skip
@pytest.mark.parametrize(
    ("parts", "step"),
    [
        *(("hexplane", s) for s in (1, 3, 4, 5, 11)),
        *(("spacetime", s) for s in (3, 6, 9)),
        *((p, s) for p in ("spike-render", "fixed-pattern") for s in (3, 6)),
        *(("paths", s) for s in (7, 8, 9, 15)),
        ("poses", 5),
        *(("average", s) for s in (2, 3, 4, 10, 11)),
        *(("spans", s) for s in (12, 13, 14)),
    ],
)
def test_killed_at_any_step_and_resumed_gives_the_same_bits(parts, step, tmp_path, hard_case: HardCase):
    expected, saved = uninterrupted(parts)
    path = tmp_path / "fit.safetensors"
    path.write_bytes(saved[step])
    second = trainer(**PARTS_WITH_STATE[parts])
    second.run(silent, path, "this")
    result = tensors(second)
    assert result.keys() == expected.keys()
    hard_case.same_bytes([bits(expected), bits(result)], ["not stopped", f"stopped at step {step}"])


@pytest.mark.hard_case(asked="a fit twice with one seed", twin="the first of the two fits", **BYTES, kind="seeds")
def test_one_seed_one_result_and_another_seed_another(hard_case: HardCase):
    again = trainer()
    again.run(silent)
    first, _ = uninterrupted()
    hard_case.same_bytes([bits(first), bits(tensors(again))], ["the first fit", "the second"])
    other = trainer()
    other.seed = 4
    other.run(silent)
    assert not torch.equal(tensors(other)["gaussians.means"][:50], first["gaussians.means"][:50])
    assert len(first["gaussians.means"]) != len(trainer().gaussians), "densification changes their number"


@pytest.mark.parametrize(
    ("part", "name", "value"),
    [
        *((TrainerSettings(), *wrong) for wrong in (("steps", 3), ("coarse_steps", 2.5), ("coarse_steps", True))),
        *((TrainerSettings(), *wrong) for wrong in (("ramp", "slow"), ("refine_poses", 1))),
        # Numbers without a logarithm, or without a meaning.
        *((TrainerSettings(), "initial_opacity", wrong) for wrong in (0.0, 1.0)),
        *((TrainerSettings(), "initial_scale", wrong) for wrong in (0.0, float("inf"), float("nan"))),
        *((TrainerSettings(), *wrong) for wrong in (("views_per_step", 0), ("views_per_step", -1), ("ramp", -1.0))),
        (DensitySettings(), "grow_scale3d", 0.0),
    ],
)
def test_an_unknown_setting_a_wrong_type_or_number_is_refused_where_it_is_given(part, name, value):
    with pytest.raises(UserError, match=name):
        make_settings({name: value}, "recipe x", part)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("motion.lr_gird", "found 'motion.lr_gird'; did you mean 'motion.lr_grid'?"),
        ("density.refine", "one of density.grow_grad2d, .*, found 'density.refine'; did you mean 'density.refine_"),
        ("lr_grid", "found 'lr_grid'; did you mean 'motion.lr_grid'?"),
        ("nowhere.xyz", "a name that `spike4dgs methods NAME` lists, found 'nowhere.xyz'; correct the name"),
    ],
)
def test_an_unknown_setting_names_the_nearest_and_where_all_are_listed(name, message):
    with pytest.raises(UserError, match=f"recipe test: .*{message}"):
        method("hexplane", {name: 1.0})


def test_settings_are_overridden_and_recorded_by_part():
    made = method("hexplane", {"motion.lr_grid": 5e-3, "images.time_spacing_ticks": 20})
    settings = made.params["settings"]
    assert settings["motion"]["lr_grid"] == 5e-3 and settings["images"]["time_spacing_ticks"] == 20
    assert settings["motion"]["features"] == SMALL_PLANES["motion.features"] and settings["initialization"] == {}
    assert set(settings) == {"images", "initialization", "motion", "supervision", "trainer", "density"}
    found = override({"images": ImageSettings()}, {"images.max_times": 9}, "here")
    assert found == {"images": ImageSettings(max_times=9)}


@pytest.mark.parametrize(
    ("recipe", "name", "value"),
    [
        ("spike4dgs-x+self-calibrated", "supervision.every", 0),
        ("spike4dgs-x+self-calibrated", "supervision.noise_px", 4),
        ("spike4dgs-x+self-calibrated", "supervision.memory", 0),
        ("tfp+stg", "motion.static_temporal_scale", 0.0),
        ("tfp+4dgs", "motion.levels", 0),
        ("tfp+4dgs", "motion.features", 0),
        ("tfp+4dgs", "motion.mlp_width", 0),
        ("tfp+4dgs", "motion.cell_px", 0.0),
        ("tfp+4dgs", "motion.cell_ticks", -1.0),
        ("spike4dgs-x", "initialization.window_ticks", 0),
        ("spike4dgs-x", "initialization.neighbours", 1),
        ("spike4dgs-x", "trainer.beta1", 1.0),
        ("spike4dgs-x", "trainer.beta2", -0.1),
        ("spike4dgs-x", "trainer.coarse_share", 3.0),
    ],
)
def test_numbers_that_no_fit_can_use_are_refused_before_it(recipe, name, value):
    part, _, setting = name.partition(".")
    with pytest.raises(UserError, match=f"settings of {part}: expected {setting} .*, found {value}"):
        get_method(recipe).with_settings({name: value}, "mine")


def test_spikes_of_no_ticks_are_refused():
    for name in ("spike_ticks", "neuron_ticks"):
        with pytest.raises(UserError, match=f"settings of supervision: expected {name} of 1 or more, found 0"):
            SpikeSettings(**{name: 0})


def test_budget_scales_steps_only():
    s = TrainerSettings()
    half = s.scaled(0.5)
    steps = ("coarse_steps", "fine_steps", "piece_steps")
    assert all(getattr(half, name) == getattr(s, name) // 2 for name in steps)
    assert replace(half, **{name: getattr(s, name) for name in steps}) == s


@pytest.mark.parametrize("motion", ["static", "hexplane", "spacetime"])
def test_a_publications_steps_see_as_many_images_whatever_the_views_of_one(motion):
    """Step counts of a publication are of steps of four views; the rounds of densification are as many, too."""
    published = MOTIONS[motion].published

    def per_image(views: int) -> dict[str, float]:
        parts = {"trainer": TrainerSettings(views_per_step=views), "density": DensitySettings()}
        found = as_dict(in_budget(parts, Budget(published=True), published, "recipe x"))
        return {name: views * found[name.split(".")[0]][name.split(".")[1]] for name in published}

    for views in (1, 2, 4, 8):
        assert per_image(views) == {name: 4 * count for name, count in published.items()}


def test_moving_scene_opens_up_from_the_middle_to_the_whole_clip():
    s = TrainerSettings(coarse_steps=200, fine_steps=400, ramp=0.5, coarse_share=0.2)
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
    with pytest.raises(UserError, match="freeze_background false, as the motion has no static stage"):
        stages(replace(s, freeze_background=True), moves=True, rests_first=False)
    (only,) = stages(s, moves=False)
    assert len({choose_time(s, only, step, 100) for step in range(200)}) > 95


@pytest.mark.parametrize("n_ticks", [1, 5, 80, 400, 10000])
def test_training_ticks_lie_inside_the_clip_and_are_bounded(n_ticks):
    ticks = choose_ticks(n_ticks, ImageSettings())
    assert 0 <= ticks[0] and ticks[-1] < n_ticks and len(ticks) <= 256 and list(ticks) == sorted(set(ticks))


def test_a_single_training_image_is_in_the_middle():
    for alone in (ImageSettings(max_times=1), ImageSettings(time_spacing_ticks=1000)):
        assert choose_ticks(401, alone) == (200,)


def test_extent_comes_from_the_points_and_not_only_from_the_array():
    scene = WORLD.training
    start = surfaces(scene, 0)
    outlier = np.array([[1e5, 0, 0]], np.float32)
    extent = measure(replace(start, points=np.concatenate([start.points, outlier])), scene)
    assert extent.scale > 1.5  # the array's own radius is 0.57 m, the scene is 4 m away
    assert float(extent.high[0]) < 10 and (extent.low < extent.high).all()


def rescaled(factor: float, shift: float = 0.0) -> tuple[Start, TrainingScene]:
    """The world with lengths in another unit, and its origin elsewhere."""
    start, scene, moved = surfaces(WORLD.training, 0), WORLD.training, np.array([shift, -shift, shift / 2])
    cameras = tuple(replace(c, t=factor * c.t - c.R @ moved) for c in start.cameras)
    points = (factor * start.points + moved).astype(np.float32)
    return replace(start, cameras=cameras, points=points), replace(scene, cameras=cameras)


@pytest.mark.parametrize(("factor", "shift"), [(1e-3, 0.0), (1.0, 1e6)])
def test_a_scene_that_cannot_be_rendered_or_resolved_is_refused(factor: float, shift: float) -> None:
    """All nearer than the near plane, as of poses in kilometres; or so far from the origin that float32 is coarse."""
    expected = "median distance of 0.00" if shift == 0 else "subtract the cameras' mean position"
    with pytest.raises(UserError, match=expected):
        measure(*rescaled(factor, shift))


@pytest.mark.parametrize(("factor", "shift"), [(0.02, 0.0), (1e4, 0.0), (1.0, 1e3)])
def test_other_units_and_origins_are_taken(factor: float, shift: float) -> None:
    assert measure(*rescaled(factor, shift)).scale == pytest.approx(factor * measure(*rescaled(1.0)).scale, rel=1e-3)
