"""Long clips: pieces of 20 ms, each fitted from where its neighbour ends."""

from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
import torch
from gaussian_clouds import cloud
from resumed import same_tensors
from saved_models import DURATION_US, gaussian_model, provenance
from toy_fits import checkpoints, images, silent, surfaces
from toy_fits import trainer as toy_trainer
from toy_world import ToyWorld

from spike4dgs.benchmark.method import Budget, FitRequest, Recipe
from spike4dgs.method.fit import Parts, RecipeMethod
from spike4dgs.method.gaussians.density import DensitySettings
from spike4dgs.method.images.training import ImageSettings, wanted_images
from spike4dgs.method.models.fitted_model import FittedModel
from spike4dgs.method.models.saved_model import load_model
from spike4dgs.method.motion import base as base_module
from spike4dgs.method.motion.base import Extent
from spike4dgs.method.motion.paths import Paths, PathSettings
from spike4dgs.method.motion.table import MOTIONS
from spike4dgs.method.schedule import TrainerSettings, choose_time, stages
from spike4dgs.method.splat.reference import rotation_matrices
from spike4dgs.method.starts.base import Initialization, at_most
from spike4dgs.method.supervision.table import SUPERVISIONS
from spike4dgs.method.torch_state import seeded
from spike4dgs.method.trainer import Trainer

WORLD = ToyWorld(width=48, height=30, n_ticks=1200, travel=0.9)


def paths(n_ticks: int) -> Paths:
    extent = Extent(torch.zeros(3), torch.ones(3), 1.0, n_ticks, 64, wanted_images(n_ticks, ImageSettings()))
    return Paths(extent, PathSettings(), seeded(0, 0))


@pytest.mark.parametrize(
    ("n_ticks", "pieces"), [(1, 1), (200, 1), (400, 1), (799, 1), (1200, 3), (2000, 5), (100_000, 13)]
)
def test_pieces_are_about_20_ms_long_and_odd(n_ticks: int, pieces: int) -> None:
    assert paths(n_ticks).pieces == pieces
    hexplane = MOTIONS["hexplane"]
    assert hexplane(paths(n_ticks).extent, hexplane.defaults, seeded(0, 0)).pieces == 1


def test_stages_go_outwards_and_each_begins_where_its_neighbour_ends() -> None:
    s = TrainerSettings(coarse_steps=100, fine_steps=200, piece_steps=150, ramp=0.5)
    rest, *moving = stages(s, moves=True, pieces=5)
    assert not rest.deforms and [m.piece for m in moving] == [2, 1, 3, 0, 4]
    assert [m.neighbour for m in moving] == [None, 2, 2, 1, 3] and [m.steps for m in moving] == [200, *[150] * 4]
    seen = {step: choose_time(s, rest, step, 1000) for step in range(100)}
    assert min(seen.values()) >= 479 and max(seen.values()) <= 520, "a fifth of the middle piece"
    for stage in moving:
        steps = range(stage.first, stage.first + stage.steps)
        times = np.array([choose_time(s, stage, step, 1000) for step in steps])
        low, high = 200 * stage.piece, 200 * (stage.piece + 1)
        assert times.min() >= low and times.max() <= high and len(set(times[len(times) // 2 :])) > 60
        if stage.neighbour is not None:
            border = high if stage.neighbour > stage.piece else low
            assert np.abs(times[:5] - border).max() <= 48 and np.abs(times - border).max() > 180
    at = {round(m.within(a), 9) for m in moving for a in m.span}
    assert at == {0.0, 1.0}


@pytest.mark.parametrize("n_ticks", [1, 200, 400, 600, 1200, 2000])
def test_a_motion_without_pieces_has_the_steps_of_pieces(n_ticks: int) -> None:
    """A deforming stage, a static scene, and a motion that has no static stage."""
    s = TrainerSettings(coarse_steps=100, fine_steps=200, piece_steps=150, coarse_share=0.2)
    motion = paths(n_ticks)
    pieces, parts = motion.pieces, motion.extent.parts
    more = 150 * (max(n_ticks, 400) / 400 - 1)
    rest, moving = stages(s, moves=True, parts=parts)
    assert (rest.steps, moving.steps, moving.span) == (100, 200 + more, (0.0, 1.0))
    assert np.ptp(rest.span) * max(n_ticks, 400) == pytest.approx(0.2 * 400), "what a piece's static stage sees"
    (floor,), (throughout,) = (stages(s, m, rests, parts=parts) for m, rests in ((False, True), (True, False)))
    assert (floor.steps, throughout.steps) == (100 + more, 300 + more)
    own = stages(s, moves=True, pieces=pieces, parts=parts)
    assert pieces in (1, n_ticks // 400) and sum(stage.steps for stage in own) == 300 + more


@pytest.mark.parametrize(
    ("motion", "budget", "total"),
    [("hexplane", 1.0, 10 + 20 + 2 * 15), ("paths", 1.0, 10 + 20 + 2 * 15), ("static", 2.0, 20 + 2 * 30)]
    + [("hexplane", None, 750 + 3750)],
)
def test_steps_of_a_fit_follow_the_clip(motion: str, budget: float | None, total: int) -> None:
    """60 ms; a publication's steps are for the whole clip."""

    class Begun(Exception):
        """The fit's first step is done."""

    def told(done: int, of: int, note: str = "") -> None:
        if of > 1:
            raise Begun(of)

    true = Initialization(lambda request: surfaces(request.scene, request.seed, WORLD))
    parts = Parts({"short": images}, {"true": true}, MOTIONS, SUPERVISIONS)
    steps = {"trainer.coarse_steps": 10, "trainer.fine_steps": 20, "trainer.piece_steps": 15}
    recipe = Recipe("test", "short", "true", motion, "pixel", {**steps, "images.time_spacing_ticks": 20})
    request = FitRequest(Budget(budget) if budget else Budget(published=True), progress=told)
    with pytest.raises(Begun, match=f"^{total}$"):
        RecipeMethod(recipe, parts).fit(WORLD.training, request)


@pytest.mark.parametrize("forward", [True, False])
def test_the_next_piece_goes_on_as_the_last_one_ends(forward: bool) -> None:
    """Position, orientation, opacity and velocity at the border are the same on both sides."""
    g, motion, h = cloud(seed=4, dtype=torch.float64), paths(1200), 1e-6
    before, after = (1.0, 0.0) if forward else (0.0, 1.0)
    follower = motion.next_piece(g, forward)
    old, new = motion.splats(g, before), motion.splats(follower, after)
    torch.testing.assert_close(new.means, old.means, rtol=0, atol=1e-12)
    torch.testing.assert_close(rotation_matrices(new.quats), rotation_matrices(old.quats), rtol=0, atol=1e-12)
    # Of a new one, at a piece's end.
    fade = torch.exp(torch.tensor(-((0.5 / PathSettings().static_temporal_scale) ** 2)))
    torch.testing.assert_close(new.opacities, old.opacities.clamp(1e-6) * fade.double(), rtol=1e-6, atol=1e-12)

    def speed(x, t):  # type: ignore[no-untyped-def]
        return (motion.splats(x, t + h).means - motion.splats(x, t - h).means) / (2 * h)

    torch.testing.assert_close(speed(follower, after), speed(g, before), rtol=0, atol=1e-6)
    # ... and straight on: the following piece has no acceleration yet
    torch.testing.assert_close(speed(follower, 0.5), speed(follower, after), rtol=0, atol=1e-6)


# Three pieces behind a background, densified at every second step.
SHORT = {"coarse_steps": 6, "fine_steps": 8, "piece_steps": 8, "freeze_background": True}
trainer = partial(toy_trainer, motion="paths", of=(WORLD, 20), **SHORT)


@cache
def uninterrupted() -> tuple[Trainer, dict[int, bytes]]:
    """A fit that has ended, and its checkpoints."""
    whole = trainer()
    return whole, checkpoints(whole)


@pytest.mark.parametrize("step", [6, 13, 14, 15, 22, 29])
def test_a_fit_of_pieces_resumes_to_the_same_bits(step: int, tmp_path: Path) -> None:
    """At the last step of a piece, and at the first and second of the next."""
    (whole, saved), second = uninterrupted(), trainer()
    (tmp_path / "c").write_bytes(saved[step])
    second.run(silent, tmp_path / "c", "this")
    assert len(whole.pieces()) == 3
    for a, b in zip(whole.pieces(), second.pieces(), strict=True):
        same_tensors(b.tensors(), a.tensors())


def test_a_piece_that_has_ended_stays_as_it_is() -> None:
    fit, (whole, _) = trainer(), uninterrupted()
    while fit.step < 15:
        fit.train_step()
    same_tensors(fit.ended[1].tensors(), whole.pieces()[1].tensors())


def test_a_cap_holds_whatever_the_images_size() -> None:
    density = DensitySettings(refine_every=2, max_gaussians=1000, grow_grad2d=0.0)
    fit = trainer(density=density, fine_steps=30, coarse_steps=20)
    start = len(fit.gaussians)
    fit.run(silent)
    assert start < 1000 and len(fit.background) + 500 <= 1500
    assert 450 < max(len(g) for g in fit.pieces()) <= 500, "without a cap 576"


def test_a_start_with_more_points_than_the_cap_is_thinned() -> None:
    start = surfaces(WORLD.training, 0, WORLD)
    points, values = at_most(500, start, 7)
    pairs = {(*p, v) for p, v in zip(start.points.tolist(), start.values.tolist(), strict=True)}
    assert len(points) == len(values) == 500 < len(start.points)
    kept = {(*p, v) for p, v in zip(points.tolist(), values.tolist(), strict=True)}
    assert len(kept) == 500 and kept <= pairs
    assert not np.array_equal(points, at_most(500, start, 8)[0]) and at_most(10**6, start, 7)[0] is start.points


def test_a_time_is_rendered_by_the_piece_that_it_lies_in(tmp_path: Path) -> None:
    """Also at the borders, at the ends, and by a model that was saved and loaded."""
    models = [gaussian_model("paths", background=40) for _ in range(3)]
    grays = (0.2, 0.5, 0.8)
    (first,) = models[0].pieces
    pieces = tuple(replace(first, colors=torch.full_like(first.colors, gray)) for gray in grays)
    model = replace(models[0], pieces=pieces)
    model.save(tmp_path / "m", provenance())
    loaded = load_model(tmp_path / "m").model
    assert isinstance(loaded, FittedModel)
    shares = ((-1, 0, 0), (0, 0, 0), (0.2, 0, 0.6), (0.5, 1, 0.5), (0.9, 2, 0.7), (1, 2, 1), (2, 2, 1))
    for share, piece, local in shares:
        for m in (model, loaded):
            splats = m.splats(share * DURATION_US)
            expected = m.motion.splats(pieces[piece], local)
            torch.testing.assert_close(splats.colors[40:], expected.colors)
            torch.testing.assert_close(splats.means[40:], expected.means, rtol=0, atol=1e-5)


def test_pieces_follow_what_one_path_through_a_long_clip_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    true = Initialization(lambda request: surfaces(request.scene, request.seed, WORLD))
    parts = Parts({"short": images}, {"true": true}, MOTIONS, SUPERVISIONS)
    steps = {"trainer.coarse_steps": 60, "trainer.piece_steps": 120, "images.time_spacing_ticks": 20}

    def fitted(fine_steps: int) -> FittedModel:
        recipe = Recipe("test", "short", "true", "paths", "pixel", {**steps, "trainer.fine_steps": fine_steps})
        return RecipeMethod(recipe, parts).fit(WORLD.training, FitRequest())  # type: ignore[return-value]

    pieces = fitted(150)
    monkeypatch.setattr(base_module, "PART_TICKS", 10_000)
    whole = fitted(390)
    assert (len(pieces.pieces), len(whole.pieces)) == (3, 1)
    assert WORLD.psnr(pieces, moving=True) > WORLD.psnr(whole, moving=True) + 2
